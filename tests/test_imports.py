"""The layout: who imports whom, and what stays unloaded."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import jaxpg

ROOT = Path(__file__).parent.parent

# The rooms of the house from the ground up: a file imports from its own room or a lower one. The library is three of
# them: maths, adapters and programs.
LEVELS = [
    {
        "errors",
        "posix",
        "types",
        "shapes",
        "returns",
        "baselines",
        "estimators",
        "losses",
        "distributions",
        "features",
        "divergence",
        "normalization",
        "compatibility",
        "collectives",
    },
    {"networks", "vector_env", "policy"},
    {"rollout", "methods", "batch", "updates", "actor_critic", "ppo", "online"}
    | {"training", "nonfinite", "shards", "evaluation"},
    {"config"},
    {"program"},
    {"store"},
    {"run"},
    {"deploy"},
    {"watch"},
    {"commands"},
    {"train", "evaluate", "inspect", "export", "render", "report", "compare", "robot", "view"}
    | {"__main__", "gymnasium", "gymnasium_env"},
]
FOREIGN = {0: {"jax"}, 1: {"jax", "flax"}, 2: {"jax", "optax"}}
LIBRARY = len(FOREIGN)


def modules():
    return sorted((ROOT / "jaxpg").rglob("*.py"))


def level(part):
    return next(i for i, names in enumerate(LEVELS) if part in names)


def imports(path):
    """Absolute names of the imported modules, anywhere in the file."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_down(path):
    parts = path.relative_to(ROOT / "jaxpg").with_suffix("").parts
    if parts == ("__init__",):
        return
    own = level(parts[0])
    for name in imports(path):
        top, _, rest = name.partition(".")
        if top == "jaxpg":
            assert rest == "" or level(rest.split(".")[0]) <= own, f"{path} imports {name}"
        elif top == "envs":
            assert own >= LIBRARY, f"{path} imports {name}: only the edge knows the environments"
        elif own < LIBRARY and top not in sys.stdlib_module_names:
            assert top in FOREIGN[own], f"{path} imports {name}"


@pytest.mark.parametrize("path", sorted((ROOT / "envs").rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT)))
def test_environments_do_not_know_the_library(path):
    assert not [name for name in imports(path) if name.split(".")[0] == "jaxpg"]


def test_there_are_no_cycles():
    graph = {}
    for path in modules() + sorted((ROOT / "envs").rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        graph[name] = set(imports(path))
    known = set(graph)
    edges = {
        name: {
            m for target in targets for m in (target, target.rpartition(".")[0]) if m in known - {name, "jaxpg", "envs"}
        }
        for name, targets in graph.items()
    }
    while edges:
        leaves = {name for name, targets in edges.items() if not targets & edges.keys()}
        assert leaves, f"cycle among {sorted(edges)}"
        edges = {name: targets for name, targets in edges.items() if name not in leaves}


def loaded_by(statement):
    """Modules that a statement loads, in a fresh interpreter."""
    code = f"import sys; {statement}; print(); print(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return set(result.stdout.splitlines()[-1].split())


@pytest.mark.parametrize(
    "statement",
    [
        "import jaxpg, jaxpg.returns, jaxpg.estimators, jaxpg.losses, jaxpg.distributions, jaxpg.normalization",
        "import jaxpg.networks, jaxpg.vector_env, jaxpg.actor_critic, jaxpg.training, jaxpg.evaluation",
    ],
)
def test_the_library_loads_nothing_heavy(statement):
    assert not loaded_by(statement) & {"mujoco", "brax", "orbax", "matplotlib", "envs"}


def test_the_librarys_modules_are_attributes_imported_at_their_first_use():
    before = loaded_by("import jaxpg; assert {'returns', 'ppo', 'load'} <= set(dir(jaxpg))")
    assert not {"jaxpg.returns", "jaxpg.ppo", "flax"} & before
    assert {"jaxpg.returns", "jaxpg.ppo"} <= loaded_by("import jaxpg; jaxpg.returns.lambda_returns, jaxpg.ppo.ppo")
    with pytest.raises(AttributeError, match="module 'jaxpg' has no attribute 'retruns'"):
        jaxpg.retruns  # noqa: B018


def test_help_loads_nothing_heavy():
    loaded = loaded_by("from jaxpg.train import main; main(['--help'])")
    assert "jaxpg.config.help" in loaded
    assert not loaded & {"mujoco", "brax", "orbax", "matplotlib", "tensorboardX"}


def test_a_stored_policy_is_read_without_what_trained_it():
    loaded = loaded_by("import jaxpg.deploy.python_policy, jaxpg.store.policies, jaxpg.store.checkpoint")
    training = {"losses", "estimators", "baselines", "batch", "updates", "actor_critic", "ppo", "online", "shards"}
    assert not loaded & {f"jaxpg.{name}" for name in training}
    assert not loaded & {"jaxpg.program.compile", "jaxpg.program.algorithms", "optax"}


def test_nothing_is_imported_before_it_is_needed():
    """Checkpoints, TensorBoard and pictures come while XLA compiles; the environment's physics when it is made."""
    loaded = loaded_by("from jaxpg.run import session")
    assert not loaded & {"mujoco", "brax", "orbax", "matplotlib", "tensorboardX"}


def test_what_is_imported_while_xla_compiles_is_there():
    assert "matplotlib.figure" in loaded_by("from jaxpg.run import session; session._import_late_modules()")

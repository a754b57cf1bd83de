"""Where a run ends: after the updates that were asked for, however it was cut, and whatever was not finite."""

import itertools
import json
import shutil
from signal import SIGTERM

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from processes import outcome

from jaxpg import train
from jaxpg.config.parsing import compose
from jaxpg.program import compile as program
from jaxpg.program.algorithms import make_algorithm
from jaxpg.program.compile import compile_program
from jaxpg.program.environment import make_env
from jaxpg.program.schedule import describe_jump, plan
from jaxpg.program.state import make_state_shape
from jaxpg.run import session
from jaxpg.run.chunks import PATIENCE, NonFiniteMonitor
from jaxpg.training import initial_state, train_chunk, train_scan
from jaxpg.types import Algorithm, TrainState

STEPS = 8  # of an update
UPDATES = 20
SIZES = ("env=quadratic", "algo=td", "network=linear", "num_envs=2", "num_steps=4", "env.episode_length=8")
SIZES += (f"total_steps={STEPS * UPDATES}", "eval_interval=1000", "eval_episodes=2", "report=false")
CHUNKS_OF_THREE = f"log_interval={3 * STEPS}"
KEY = jax.random.key(0)


def configured(*options):
    """The configuration of such a run, but for these options."""
    given = dict(option.split("=") for option in (*SIZES, *options))
    return compose([f"{name}={value}" for name, value in given.items()])


def same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def updates_of(folder):
    return [json.loads(line)["update"] for line in (folder / "metrics.jsonl").read_text().splitlines()]


# --- the number of updates --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("log_interval", [1, 23, 24, 25, 1000])
@pytest.mark.parametrize("total_steps", [1, 8, 159, 160, 161])
def test_intervals_do_not_change_the_number_of_updates(total_steps, log_interval):
    schedule = plan(configured(f"total_steps={total_steps}", f"log_interval={log_interval}"))
    assert schedule.num_updates == -(-total_steps // STEPS)


@pytest.mark.parametrize("log_interval", [1, 24, 25, 1000])
def test_lines_come_at_the_same_updates_wherever_a_run_goes_on(log_interval):
    """After multiples of the chunk and at the end, each reached from anywhere before it."""
    schedule = plan(configured(f"log_interval={log_interval}"))
    ends = {*range(schedule.chunk, UPDATES, schedule.chunk), UPDATES}
    for update in range(UPDATES):
        assert update + schedule.updates_to_next_line(update) == min(end for end in ends if end > update)


@pytest.mark.parametrize("agents", [(), ("num_seeds=2", "vmap_seeds=2"), ("num_envs=4", "algo.num_shards=2")])
def test_one_program_makes_parts_of_any_length(agents):
    """To the bit the training in one piece; and only as many rows of metrics as updates."""
    config = configured(*agents)
    with jax.debug_key_reuse(False):  # see test_vmapped_seeds_are_single_seeds
        compiled = compile_program(config, make_env(config), chunk=5)
    begun = compiled.init().train

    def trained(numbers):
        train, metrics = begun, []
        for number in numbers:
            train, found = compiled.advance(train, number)
            metrics.append(found)
            assert {x.shape[1] for x in found.values()} == {number}
        return train, {name: np.concatenate([found[name] for found in metrics], axis=1) for name in metrics[0]}

    whole = trained([5, 5])
    for numbers in ([1, 4, 5], [3, 3, 3, 1]):
        same(trained(numbers), whole)


def close(a, b):
    """To rounding: XLA does not make a loop of a single round, whose numbers it may fuse in another way."""
    np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_a_chunk_is_the_scan_of_its_updates():
    config = configured()
    algorithm = make_algorithm(config, make_env(config))
    begun = initial_state(algorithm, KEY)
    chunk = jax.jit(lambda number: train_chunk(algorithm, KEY, 5, number, begun))
    for number in (1, 4, 5):
        state, metrics = jax.jit(lambda number=number: train_scan(algorithm, KEY, number, begun))()
        found, rows = chunk(number)
        jax.tree.map(close, found, state)
        for name, row in rows.items():
            close(row[:number], metrics[name])
            np.testing.assert_array_equal(row[number:], 0)


class StopAfter:
    """In the place of `StopRequests`: a signal comes when the host has looked for it `looks` times."""

    looks = 0

    def __enter__(self):
        self.left = self.looks
        return self

    def __exit__(self, *exception):
        pass

    @property
    def signal(self):
        self.left -= 1
        return SIGTERM if self.left < 0 else None


def test_a_run_that_was_stopped_ends_where_one_ends_that_was_not(tmp_path, monkeypatch):
    """To the bit, where the total is no multiple of a chunk; with other intervals the run ends at the same update."""
    arguments = [*SIZES, CHUNKS_OF_THREE]
    assert train.main([*arguments, f"run_dir={tmp_path / 'whole'}"]) == 0
    with monkeypatch.context() as patch:
        patch.setattr(StopAfter, "looks", 2)
        patch.setattr(session, "StopRequests", StopAfter)
        assert train.main([*arguments, f"run_dir={tmp_path / 'cut'}"]) == 128 + SIGTERM
    assert updates_of(tmp_path / "cut") == [3, 6]
    assert train.main([f"resume={tmp_path / 'cut'}"]) == 0
    assert updates_of(tmp_path / "cut") == updates_of(tmp_path / "whole") == [3, 6, 9, 12, 15, 18, 20]
    assert outcome(tmp_path / "cut") == outcome(tmp_path / "whole")
    assert train.main([*SIZES, f"log_interval={7 * STEPS}", f"run_dir={tmp_path / 'other'}"]) == 0
    assert updates_of(tmp_path / "other") == [7, 14, 20]
    assert outcome(tmp_path / "other")[1:] == outcome(tmp_path / "whole")[1:]


def test_a_return_that_was_reached_after_the_last_checkpoint_is_reached_again(tmp_path, capsys):
    """As after a kill between the line that has it and the checkpoint: the best policy is on no disk yet."""
    run, undisturbed = tmp_path / "run", tmp_path / "undisturbed"
    arguments = [size for size in SIZES if not size.startswith("eval_interval")]
    arguments += [CHUNKS_OF_THREE, "eval_interval=1", f"checkpoint_interval={3 * STEPS}"]
    assert train.main([*arguments, f"run_dir={undisturbed}"]) == 0
    returns = [json.loads(line)["eval_return"] for line in (undisturbed / "metrics.jsonl").read_text().splitlines()]
    stop = f"stop_return={max(returns)}"
    assert train.main([*arguments, stop, f"run_dir={run}"]) == 0
    reached = outcome(run)
    shutil.rmtree(run / "checkpoints" / str(reached[1]))
    capsys.readouterr()
    assert train.main([f"resume={run}"]) == 0
    assert "has reached" not in capsys.readouterr().out
    assert outcome(run) == reached


# --- schedules --------------------------------------------------------------------------------------------------------

SCHEDULED = ("network.sigma_is=scheduled", "network.sigma=0.8", "network.final_sigma=0.05", "algo.final_lr=0.1")
PPO = ("algo=ppo", "algo.epochs=3", "algo.minibatches=2")


def sigma(state):
    return float(np.exp(state.params["actor"]["params"]["log_std"][0]))


def expected_sigma(update, num_updates):
    return 0.8 * (0.05 / 0.8) ** min(update / num_updates, 1)


def one_by_one(config, state=None):
    """The state after each further update, and its metrics, for ever."""
    algorithm = make_algorithm(config, make_env(config))
    update = jax.jit(lambda state: train_scan(algorithm, KEY, 1, state))
    state = state or initial_state(algorithm, KEY)
    while True:
        state, metrics = update(state)
        yield state, metrics


@pytest.mark.parametrize("algo", [("algo=td",), PPO, (*PPO, "algo.max_kl=1e-9")], ids=["td", "ppo", "stopped early"])
def test_schedules_follow_the_updates_and_not_the_gradient_steps(algo):
    """As many as were taken, or were left out beyond max_kl: sigma is where it belongs after each update."""
    updates = one_by_one(configured(*algo, *SCHEDULED))
    for update in range(1, UPDATES + 1):
        state, metrics = next(updates)
        np.testing.assert_allclose(sigma(state), expected_sigma(update, UPDATES), rtol=1e-5)
    if "algo.max_kl=1e-9" in algo:
        assert metrics["gradient_steps"][0] == 1


def test_step_sizes_follow_the_updates_and_not_the_gradient_steps():
    """One step of Adam moves a parameter by the step size; all but one of six steps are left out here."""
    config = configured(*PPO, "algo.max_kl=1e-9", "algo.final_lr=0", "algo.actor_lr=0.01")
    algorithm = make_algorithm(config, make_env(config))

    @jax.jit
    def after(update):
        begun = initial_state(algorithm, jax.random.key(0))
        state, _ = algorithm.step(begun._replace(update=update), jax.random.key(1))
        return jax.tree.map(lambda a, b: jnp.abs(a - b).max(), state.params["actor"], begun.params["actor"])

    def moved(update):
        return max(map(float, jax.tree.leaves(after(jnp.int32(update)))))

    first = moved(0)
    for update in (5, 10, 15):
        np.testing.assert_allclose(moved(update) / first, 1 - update / UPDATES, rtol=1e-4)
    assert max(moved(UPDATES), moved(UPDATES + 3)) < 1e-6 * first


def test_a_longer_run_goes_on_as_if_it_had_been_that_long():
    """After a resume with twice the steps: sigma and step sizes of that run, and never beyond their last values."""
    short, long = (configured(*SCHEDULED, f"total_steps={STEPS * n}") for n in (UPDATES, 2 * UPDATES))
    state, _ = next(itertools.islice(one_by_one(short), UPDATES + 2, None))
    np.testing.assert_allclose(sigma(state), 0.05, rtol=1e-5)
    updates = one_by_one(long, state)
    for update in range(UPDATES + 4, 2 * UPDATES + 3):
        state, _ = next(updates)
        np.testing.assert_allclose(sigma(state), expected_sigma(update, 2 * UPDATES), rtol=1e-5)


def test_what_jumps_on_resume_is_said():
    def said(before, after, update, *options):
        configs = [configured(*options, f"total_steps={STEPS * n}") for n in (before, after)]
        return describe_jump(*configs, update)

    words = "continues as in a run of 320 steps: step sizes are 55.0% of the initial ones, not 10.0%"
    assert said(20, 40, 20, "algo.final_lr=0.1") == words
    assert said(20, 40, 20, *SCHEDULED) == f"{words}; sigma is 0.2, not 0.05"
    assert said(20, 20, 10, *SCHEDULED) is None
    assert said(20, 40, 20, "algo.final_lr=1") is None
    assert said(20, 40, 20, "algo=online") is None
    assert said(20, 40, 0, *SCHEDULED) is None
    assert "step sizes jump" in said(20, 40, 20, "sweep.algo.final_lr=[0.1,0.2]")


def test_updates_that_are_left_out_hold_no_schedule_up(tmp_path, exploding_at):
    exploding_at(2, 3, UPDATES - 1)
    config = configured(*SCHEDULED, "nan_policy=skip")
    compiled = compile_program(config, make_env(config), chunk=UPDATES)
    train_state, metrics = compiled.advance(compiled.init().train)
    assert (metrics["nonfinite"] > 0).sum() == 3
    found = float(np.exp(np.asarray(train_state.params["actor"]["params"]["log_std"])[0, 0]))
    np.testing.assert_allclose(found, 0.05, rtol=1e-5)


# --- updates that are not finite --------------------------------------------------------------------------------------


@pytest.fixture
def exploding_at(monkeypatch):
    """`exploding_at(2, 3)`: the algorithms of a run have a value_loss that is not finite in these updates."""
    make = program.make_algorithm

    def explode(*updates):
        def exploding(config, env):
            algorithm = make(config, env)

            def step(state, key):
                new, metrics = algorithm.step(state, key)
                bad = jnp.isin(new.update, jnp.array(updates))
                return new, metrics | {"value_loss": jnp.where(bad, jnp.nan, metrics["value_loss"])}

            return Algorithm(algorithm.init, step)

        monkeypatch.setattr(program, "make_algorithm", exploding)

    return explode


def test_a_chunk_of_one_update_is_left_out_like_any_other(tmp_path, exploding_at, capsys):
    exploding_at(4, 5, 11)
    folder = tmp_path / "run"
    assert train.main([*SIZES, "log_interval=1", "nan_policy=skip", f"run_dir={folder}"]) == 0
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [line["update"] for line in lines if line["skipped"]] == [4, 5, 11]
    assert len(lines) == outcome(folder)[1] == UPDATES
    capsys.readouterr()
    assert train.main([*SIZES, "nan_policy=skip", "log_interval=1000", f"run_dir={tmp_path / 'whole'}"]) == 0
    assert outcome(folder)[2] == outcome(tmp_path / "whole")[2]


def test_a_run_that_stops_inside_a_chunk_ends_there(tmp_path, exploding_at, capsys):
    """The checkpoint bears the number of its updates, the same again on resume, and without the update it goes on."""
    folder = tmp_path / "run"
    exploding_at(9)
    arguments = [*SIZES, f"log_interval={5 * STEPS}", f"run_dir={folder}"]
    assert train.main(arguments) == session.DIVERGED_STATUS
    assert f"error: update 9: value_loss is not finite; stopped at {8 * STEPS} steps" in capsys.readouterr().out
    lines, number, _ = found = outcome(folder)
    assert number == 8
    assert [line["update"] for line in lines] == [5, 8]
    assert all(line["skipped"] == 0 for line in lines)
    assert train.main([f"resume={folder}"]) == session.DIVERGED_STATUS
    assert outcome(folder) == found
    assert train.main([f"resume={folder}", "nan_policy=skip"]) == 0
    assert updates_of(folder) == [5, 8, 10, 15, 20]
    assert outcome(folder)[1] == UPDATES


def test_agents_that_stood_still_end_with_the_others(tmp_path, monkeypatch):
    """On resume with nan_policy=skip they go on at the update of the run."""
    make = program.make_algorithm

    def exploding(config, env):
        algorithm = make(config, env)

        def step(state, key):
            new, metrics = algorithm.step(state, key)
            first = jnp.all(jax.random.key_data(key) == jax.random.key_data(jax.random.fold_in(jax.random.key(0), 4)))
            return new, metrics | {"value_loss": jnp.where(first, jnp.nan, metrics["value_loss"])}

        return Algorithm(algorithm.init, step)

    monkeypatch.setattr(program, "make_algorithm", exploding)
    monkeypatch.setattr(StopAfter, "looks", 2)
    folder, arguments = tmp_path / "run", [*SIZES, CHUNKS_OF_THREE, "num_seeds=2"]
    with monkeypatch.context() as patch:
        patch.setattr(session, "StopRequests", StopAfter)
        assert train.main([*arguments, f"run_dir={folder}"]) == 128 + SIGTERM
    assert _updates_of_agents(folder) == [3, 6]
    assert train.main([f"resume={folder}", "nan_policy=skip"]) == 0
    assert _updates_of_agents(folder) == [UPDATES, UPDATES]


def _updates_of_agents(folder):
    from jaxpg.store.checkpoint import Checkpoints

    config = configured("num_seeds=2")
    shape = make_state_shape(make_algorithm(config, make_env(config)), 2)
    checkpoints = Checkpoints(folder / "checkpoints", read_only=True)
    return np.asarray(checkpoints.restore(checkpoints.latest(), shape).train.update).tolist()


def looked(policy, *rows, patience=PATIENCE):
    """Whether nobody goes on, after chunks of such updates; 1 is unsound."""
    monitor = NonFiniteMonitor(compose(["num_seeds=2", f"nan_policy={policy}"]), lambda text: None, patience)
    for row in rows:
        unsound = np.broadcast_to(np.asarray(row, int), (2, np.shape(row)[-1]))
        nothing = np.zeros(unsound.shape)
        metrics = {"nonfinite": unsound, "nonfinite_env": nothing - 1, "diverged": nothing, "value_loss": nothing}
        monitor.observe(TrainState(None, None, None, None, np.zeros(2, int)), metrics)
    return monitor.is_stuck


def test_who_stops_does_not_go_on_and_who_skips_has_patience():
    assert looked("stop", [0, 1])
    assert looked("stop", [[0, 0, 1], [0, 1, 1]])
    assert not looked("stop", [[0, 0, 1], [0, 0, 0]])
    assert not looked("skip", *[[1]] * (PATIENCE - 1))
    assert looked("skip", *[[1]] * PATIENCE)
    assert looked("skip", [0] + [1] * (PATIENCE - 1), [1])
    assert not looked("skip", [1] * (PATIENCE - 1), [0], [1] * (PATIENCE - 1))
    assert not looked("skip", [[1] * 500, [1] * 499 + [0]])
    assert looked("skip", [1, 1], [1], patience=3)


def test_a_run_none_of_whose_updates_can_be_applied_says_so(tmp_path, exploding_at, capsys):
    """It ends with status 4 and is saved where it is: on resume it tries further updates."""
    exploding_at(*range(1, UPDATES + 1))
    folder = tmp_path / "run"
    arguments = [*SIZES, "log_interval=8", "nan_policy=skip", f"run_dir={folder}"]
    assert train.main(arguments) == session.DIVERGED_STATUS
    assert f"the last {UPDATES} updates could not be applied" in capsys.readouterr().out
    assert outcome(folder)[1] == UPDATES

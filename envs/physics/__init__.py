"""Physics of the environments: one step of a MuJoCo model, as a function of the few arrays that change."""

from envs.batches import divide_batch
from envs.physics.check import check_model, check_once, load_model
from envs.physics.collision import COLLISION, change_collision
from envs.physics.description import Description, describe
from envs.physics.features import unsupported_features
from envs.physics.forward import compile_forward, compile_inverse
from envs.physics.interpreter import scalarize
from envs.physics.models import MujocoModelError, compile_model, ignored_features, load_spec
from envs.physics.pairs import Pair, candidate_pairs
from envs.physics.primitives import UnsupportedPrimitiveError
from envs.physics.step import PHYSICS, compile_step
from envs.physics.variants import derive_fields, differing_fields

__all__ = [
    "COLLISION",
    "PHYSICS",
    "Description",
    "MujocoModelError",
    "Pair",
    "UnsupportedPrimitiveError",
    "candidate_pairs",
    "change_collision",
    "check_model",
    "check_once",
    "compile_forward",
    "compile_inverse",
    "compile_model",
    "compile_step",
    "derive_fields",
    "describe",
    "differing_fields",
    "divide_batch",
    "ignored_features",
    "load_model",
    "load_spec",
    "scalarize",
    "unsupported_features",
]

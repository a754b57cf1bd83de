"""What moves the environments: one step of a MuJoCo model as a function of (qpos, qvel, ctrl)."""

from envs.physics.mjx_step import MujocoModelError, compile_model, load_spec, mjx_step

__all__ = ["MujocoModelError", "compile_model", "load_spec", "mjx_step"]

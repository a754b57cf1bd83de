"""C MuJoCo's step as functions of jax arrays, which `envs.physics.interpreter` turns into scalar equations."""

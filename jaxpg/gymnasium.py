"""Importing this module registers the environments with Gymnasium.

    import gymnasium
    import jaxpg.gymnasium

    env = gymnasium.make("jaxpg/Pendulum-v0", mass=2.0)
    envs = gymnasium.make_vec("jaxpg/Arm-v0", num_envs=64)

Gymnasium does not search for plug-ins, but imports the module before a colon: any tool that takes names can use
`jaxpg.gymnasium:jaxpg/Pendulum-v0`. JAX and MuJoCo are loaded only when an environment is made.
"""

import gymnasium

# Name, the registry's key, time limit: the default of its episode_length.
ENVIRONMENTS = (("jaxpg/Pendulum-v0", "pendulum", 200), ("jaxpg/Arm-v0", "arm", 100))

for name, env, max_episode_steps in ENVIRONMENTS:
    gymnasium.register(
        name,
        entry_point="jaxpg.gymnasium_env:make",
        vector_entry_point="jaxpg.gymnasium_env:make_vec",
        max_episode_steps=max_episode_steps,
        kwargs={"env": env},
    )

"""Robots that move in space, for tests of their pictures."""

ARM = """<mujoco><worldbody><geom type="plane" size="1 1 1" pos="0 0 -.1"/>
  <body pos="0 0 .2" quat="1 0 0 .5"><joint axis="0 0 1"/><geom type="capsule" fromto="0 0 0 0 0 .5" size=".05"/>
    <body pos="0 0 .5"><joint axis="0 1 0" pos="0 0 .02"/><geom type="box" size=".2 .03 .03" pos=".2 0 0"/>
      <site name="tip" pos=".4 0 0"/></body></body>
</worldbody></mujoco>"""
RUNNER = """<mujoco><worldbody><geom type="box" size="1 1 .1" pos="9 9 9"/>
  <body pos="0 0 .3"><freejoint/><geom type="box" size=".2 .1 .05"/>
    <body pos=".2 0 0"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02"/></body></body>
</worldbody></mujoco>"""

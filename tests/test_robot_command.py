"""`python -m jaxpg.robot PATH`: what it finds out about a robot, what it says is to be changed, and how it ends."""

import json
import logging

import mujoco
import published
import pytest
from in_process import ended

import envs
from envs.physics import compile_model
from envs.robots import load_robot, read_arm
from jaxpg.commands import robot, train
from jaxpg.commands.ending import run_command

HINGE = '<joint name="j{i}" axis="{axis}" range="-2 2"/>'
MOTOR = '<motor name="a{i}" joint="j{i}" ctrlrange="-20 20"/>'
SERVO = '<position name="a{i}" joint="j{i}" kp="50" kv="1" ctrlrange="-2 2"/>'
LINK = '<geom type="capsule" size="0.02" fromto="0 0 0.05 0 0 0.25" mass="1"/>'
FINGERS = "".join(
    f'<body name="{name}" pos="0 0 0.3"><joint name="{name}" type="slide" axis="0 {sign}1 0" range="0 0.04"/>'
    f'<geom size="0.01" mass="0.1" pos="0 {sign}0.02 0.02"/></body>'
    for name, sign in (("left_finger", ""), ("right_finger", "-"))
)
SPLIT = """<tendon><fixed name="split"><joint joint="left_finger" coef="0.5"/><joint joint="right_finger" coef="0.5"/>
</fixed></tendon><equality><joint joint1="left_finger" joint2="right_finger"/></equality>"""
PULL = '<general name="gripper" tendon="split" ctrlrange="0 255" gainprm="0.3" biastype="affine" biasprm="0 -100 -10"/>'


def chain(joint=HINGE, link=LINK, site="", tip="", numbers=range(3)):
    """The bodies of an arm, with something at its `tip`."""
    bodies = "".join(
        f'<body name="link{i}" pos="0 0 0.3">{joint.format(i=i, axis="0 1 0" if i % 3 else "0 0 1")}{link}'
        for i in numbers
    )
    return bodies + site + tip + "</body>" * len(numbers)


def arm(motor=MOTOR, site='<site name="tcp" pos="0 0 0.3"/>', *, head="", world="", actuators="", end="", **parts):
    """MJCF of an arm of three joints, with something before and after it, among its actuators, or after them."""
    motors = "".join(motor.format(i=i) for i in range(3))
    return f"""<mujoco model="robot"><compiler angle="radian"/><option integrator="implicitfast"/>{head}
    <worldbody>{chain(site=site, **parts)}{world}</worldbody>
    <actuator>{motors}{actuators}</actuator>{end}</mujoco>"""


OTHER_ARM = chain(numbers=range(3, 6)).replace('pos="0 0 0.3"', 'pos="1 0 0.3"', 1)
TWO_ARMS = arm(world=OTHER_ARM, actuators="".join(MOTOR.format(i=i) for i in range(3, 6)))
TRUNK = '<body name="trunk"><freejoint name="base"/><geom size="0.1" mass="1"/>'
WALKER = TWO_ARMS.replace("<worldbody>", f"<worldbody>{TRUNK}").replace("</worldbody>", "</body></worldbody>")
GRIPPER = f"""<mujoco model="gripper"><worldbody><body name="palm">{FINGERS}</body></worldbody>{SPLIT}
<actuator>{PULL}</actuator></mujoco>"""


@pytest.fixture
def write(tmp_path, monkeypatch):
    """`write(xml)`: the name of a file of it in the working folder."""
    monkeypatch.chdir(tmp_path)

    def write(xml, name="robot.xml"):
        (tmp_path / name).write_text(xml)
        return name

    return write


def survey(*arguments):
    """Exit status, the table or the JSON's values, and the errors of the command, which measures nothing."""
    status, output, error = ended(robot.main, [*arguments, "measure=false"])
    return status, json.loads(output) if "json=true" in arguments else output, error


def block(table, title):
    """The lines of a table under a title, without their indentation."""
    lines = iter(table.split(f"\n{title}\n")[1].splitlines())
    return [line.removeprefix("  ") for line in iter(lambda: next(lines, ""), "")]


def test_an_arm_with_a_gripper_that_a_tendon_moves(write):
    key = '<keyframe><key name="home" qpos="0 0.5 0.5 0 0" ctrl="0 0 0 255"/></keyframe>'
    speeds = '<custom><numeric name="velocity_limit" data="1 2 3"/></custom>'
    status, table, error = survey(write(arm(tip=FINGERS, actuators=PULL, end=SPLIT + key + speeds)))
    assert (status, error) == (0, "")
    assert table.startswith("robot: 5 joints, 4 actuators, a fixed base, physics in steps of 0.002 s\n")
    rows = [line.split() for line in block(table, "joints")[1:]]
    assert [row[:3] for row in rows] == [
        *([f"j{i}", "arm", "hinge"] for i in range(3)),
        *([f"{side}_finger", "gripper", "slide"] for side in ("left", "right")),
    ]
    assert rows[1] == ["j1", "arm", "hinge", "+-2", "rad", "0.5", "a1", "motor", "+-20", "N", "m"]
    assert rows[3][3:] == ["0", "to", "0.04", "m", "0", "tendon", "'split'"]
    assert block(table, "other actuators") == [
        "gripper: acts on tendon 'split', range 0 to 255; keeps 255, as no action commands it"
    ]
    assert block(table, "sites") == ["tcp  (end effector)"]
    assert "moves as C MuJoCo does, to 1e-3 over 200 steps from each start" in block(table, "physics")
    assert block(table, "reach") == [
        "env.control=torque    up to 10 N m",
        "env.control=velocity  up to 1 2 3 rad/s",
        "env.control=position  up to 0.2 rad",
        "env.control=twist     up to 0.5 m/s, 1.5 rad/s",
        "100% of random poses are free of collisions and above the ground",
    ]
    assert "\nwhat to change\n" not in table
    (command,) = block(table, "train it")
    assert command.endswith(" -m jaxpg.train env=reach env.robot=robot.xml")


def test_what_the_last_joint_of_the_arm_carries_is_a_gripper_whatever_its_name(write):
    path = write(arm(tip=FINGERS, actuators=PULL, end=SPLIT).replace("_finger", "_rod"))
    _, values, _ = survey(path, "json=true")
    assert [joint["part"] for joint in values["joints"]] == ["arm"] * 3 + ["gripper"] * 2
    _, values, _ = survey(path, "json=true", "site=left_rod")
    assert [joint["part"] for joint in values["joints"]] == ["arm"] * 4 + ["other"]


def test_what_the_model_does_not_say_is_to_be_written(write):
    """Each line has MJCF which, written into the file, is what the line asks for."""
    path = write(arm(joint='<joint name="j{i}" axis="{axis}"/>', motor=SERVO, site=""))
    _, values, _ = survey(path, "json=true")
    changes = " ".join(values["changes"])
    for line in (
        '<joint name="j0" range="-3.1416 3.1416"/>',
        "actuator 'a2' has no largest torque",
        '<key name="home" qpos="0 0 0"/>',
        '<site name="tcp" pos="0 0 0.15"/> in body \'link2\'',
        '<numeric name="velocity_limit" data="2 2 2"/>',
    ):
        assert line in changes
    better = arm(
        joint='<joint name="j{i}" axis="{axis}" range="-3.1416 3.1416"/>',
        motor=SERVO.replace("/>", ' forcerange="-50 50"/>'),
        site='<site name="tcp" pos="0 0 0.15"/>',
        end='<keyframe><key name="home" qpos="0 0 0"/></keyframe><custom><numeric name="velocity_limit" data="2 2 2"/>'
        "</custom>",
    )
    status, values, _ = survey(write(better), "json=true")
    assert (status, values["changes"], values["guesses"], values["notes"]) == (0, [], [], [])


def test_a_pose_at_rest_outside_of_ranges_or_with_bodies_in_each_other(write):
    ball = '<body name="ball" pos="0 0 1.1"><geom size="0.05"/></body>'
    key = '<keyframe><key name="home" qpos="0 0 2.5"/></keyframe>'
    _, values, _ = survey(write(arm(world=ball, end=key)), "json=true")
    changes = " ".join(values["changes"])
    assert "joint 'j2' rests at 2.5 rad, outside its range from -2 to 2" in changes
    assert "penetrate" not in changes
    _, values, _ = survey(write(arm(world=ball)), "json=true")
    (line,) = [line for line in values["changes"] if "penetrate" in line]
    assert '<exclude body1="link2" body2="ball"/>' in line
    exclude = '<contact><exclude body1="link2" body2="ball"/></contact>'
    _, values, _ = survey(write(arm(world=ball, end=exclude)), "json=true")
    assert not [line for line in values["changes"] if "penetrate" in line]


def test_meshes_that_would_collide_are_told(write, tmp_path):
    (tmp_path / "bar.obj").write_text(
        "v 0 0 0\nv 0.05 0 0\nv 0 0.05 0\nv 0 0 0.25\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    path = write(
        arm(head='<asset><mesh name="bar" file="bar.obj"/></asset>', link='<geom type="mesh" mesh="bar" mass="1"/>')
    )
    _, table, _ = survey(path)
    assert block(table, "collision") == [
        "meshes do not collide; 0 pairs of other geoms can meet within the joints' ranges"
    ]
    assert "2 meshes would collide, which scalar equations leave out" in block(table, "what to change")[0]
    _, table, _ = survey(path, "collision=hull")
    assert block(table, "collision") == [
        "1 of 1 pairs of geoms that collide can meet within the joints' ranges",
        "link0 - link2",
    ]
    assert "meshes would collide" not in table
    assert block(table, "train it")[0].endswith(" env.robot=robot.xml env.collision=hull")


def test_options_are_those_of_the_training(write):
    path = write(arm(motor=SERVO.replace("/>", ' forcerange="-9 9"/>')))
    status, table, error = survey(path, "control=torque", "site=link1")
    assert status == 2
    assert error == (
        "error: env.control=torque: the actuators of robot are position servos (joint 'j0'); command them by "
        "env.control=velocity, position or twist\n"
    )
    assert block(table, "train it") == ["not as it is: see above"]
    status, table, _ = survey(path, "site=link1", "speed=0.5", "control=twist")
    assert status == 0
    assert "env.control=velocity  up to 0.5 rad/s" in block(table, "reach")
    (command,) = block(table, "train it")
    assert command.endswith(" env=reach env.robot=robot.xml env.site=link1 env.control=twist env.speed=0.5")


@pytest.mark.parametrize(
    ("xml", "base", "task"),
    [
        (WALKER, "trunk", "walk"),
        (WALKER.replace(' range="-2 2"', ""), "trunk", "drive"),
        (GRIPPER, "", ""),
    ],
)
def test_a_robot_without_an_arm_is_described_and_has_no_problem(write, xml, base, task):
    status, values, error = survey(write(xml), "json=true")
    assert (status, error) == (0, "")
    assert (values["base"], values["task"], values["commands"], values["free_share"]) == (base, task, [], None)
    assert not [joint for joint in values["joints"] if joint["part"] == "arm"]


def test_a_robot_that_c_mujoco_has_to_step(write):
    status, table, _ = survey(write(arm(actuators='<adhesion body="link2" ctrlrange="0 1" gain="5"/>')))
    assert status == 0
    assert block(table, "physics")[0].startswith(
        "stepped by C MuJoCo, at its speed and without gradients, because of: "
    )
    assert "only C MuJoCo has: actuators with the transmission type body" in block(table, "physics")


def test_a_robot_whose_motion_is_not_computed_well(write):
    stiff = arm(motor='<position name="a{i}" joint="j{i}" kp="1e6"/>').replace(' integrator="implicitfast"', "")
    status, _, error = survey(write(stiff))
    assert status == 2
    assert len(error.splitlines()) == 1
    assert "C MuJoCo's own motion diverges" in error
    assert 'integrator="implicitfast"' in error


def test_the_physics_is_measured(write):
    status, output, _ = ended(robot.main, [write(arm()), "json=true"])
    assert status == 0
    assert min(json.loads(output)["measured"].values()) > 0


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ([], "the robot is missing: its .xml file or its name, such as "),
        (["panda", "arm.xml"], "2 robots, expected one, such as "),
        (["pandaa"], "unknown robot 'pandaa': did you mean 'panda'?"),
        (["missing.xml"], "env.robot=missing.xml: there is no such file"),
        (["panda", "sites=flange"], "unknown option 'sites': did you mean 'site'?"),
        (["panda", "control=torques"], "control=torques: must be torque or velocity or position or twist"),
    ],
)
def test_mistakes_are_one_line(arguments, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, output, error = ended(robot.main, arguments)
    assert (status, output) == (2, "")
    assert error.startswith(f"error: {line}")
    assert len(error.splitlines()) == 1


# Robots that do not fit, with a part of the line that says so, and whether the file can be described at all.
UNFIT = {
    "no actuators": (arm(motor=""), "the model has no actuators; add one for each joint of the arm: <motor", True),
    "no joints": ("<mujoco><worldbody><body><geom size='1'/></body></worldbody></mujoco>", "nothing can move", False),
    "slides without a range": (
        arm(joint='<joint name="j{i}" type="slide" axis="{axis}"/>'),
        "slide joint 'j0' has no range; give it one",
        True,
    ),
    "motors without a limit": (arm(motor='<motor joint="j{i}"/>'), "the torque of joint 'j0' is not limited", True),
    "motors of one side": (
        arm(motor='<motor joint="j{i}" ctrlrange="0 9"/>'),
        "not limited on both sides (0 to 9); give its motor a range",
        True,
    ),
    "ranges of nothing": (arm(motor='<motor joint="j{i}" ctrllimited="true"/>'), "invalid control range", False),
    "ranges that are no numbers": (
        arm(motor=MOTOR.replace("-20 20", "nan 20")),
        "ctrlrange of actuator 'a0' is not a number (NaN)",
        False,
    ),
    "muscles": (arm(motor='<muscle joint="j{i}"/>'), "of joint 'j0' is neither a motor nor a servo; an arm", True),
    "gears of 0": (arm(motor=MOTOR.replace("/>", ' gear="0"/>')), "actuator 'a0' of joint 'j0' has gear 0", True),
    "a ball joint": (
        arm(tip='<body><joint name="b" type="ball"/><geom size="0.1"/><site name="tool"/></body>', site=""),
        "ball joint 'b' carries the end effector",
        True,
    ),
    "two arms": (
        TWO_ARMS,
        "the robot has several arms of 3 joints, which end at link2, link5; choose one with env.site=NAME",
        True,
    ),
    "a mesh that gives the inertia": (
        arm(head='<asset><mesh name="m" file="m.stl"/></asset>', link='<geom type="mesh" mesh="m"/>'),
        "would come from the mesh 'm', whose file is missing: give the body an <inertial>",
        False,
    ),
    "a keyframe of another size": (
        arm(end='<keyframe><key name="home" qpos="0 0 0 0"/></keyframe>'),
        "keyframe 'home': invalid qpos size, expected 3, got 4",
        False,
    ),
    "no time between steps": (arm(head='<option timestep="0"/>'), 'timestep="0"/> must be above 0 seconds', False),
    "speeds of other joints": (
        arm(end='<custom><numeric name="velocity_limit" data="1 2"/></custom>'),
        "has the numbers 1 2; expected 3 above 0, one for each joint of the arm",
        True,
    ),
    "broken XML": ("<mujoco><worldbody></mujoco>", "robot.xml: XML", False),
    "no XML": ("solid stl", "robot.xml: XML", False),
    "an include that is missing": (arm(end='<include file="more.xml"/>'), "Error opening file 'more.xml'", False),
    "URDF": ('<robot name="u"><link name="base"/></robot>', "a URDF has no actuators; make MJCF of it", False),
}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("kind", UNFIT)
def test_a_robot_that_does_not_fit(kind, write):
    """One line and status 2, of the check as of a training, and no run folder."""
    xml, words, is_described = UNFIT[kind]
    path = write(xml)
    for main, arguments in (
        (robot.main, [path, "measure=false"]),
        (train.main, ["env=reach", f"env.robot={path}", "total_steps=1000", "run_dir=run"]),
    ):
        status, output, error = ended(main, arguments)
        (line,) = [line for line in error.splitlines() if line.startswith("error: ")]
        assert status == 2
        if kind != "no joints" or main is robot.main:
            assert words in line
        assert "Traceback" not in error
        if main is robot.main:
            assert bool(output) == is_described


def test_a_free_base_does_not_reach(write):
    status, _, error = ended(train.main, ["env=reach", f"env.robot={write(WALKER)}", "total_steps=1000"])
    line = "error: env.robot: body 'trunk' moves freely, so the robot has no fixed base; reach is for arms on one "
    assert (status, error) == (2, f"{line}(env=walk and env=drive move a base)\n")


@pytest.mark.parametrize(
    ("xml", "guess"),
    [
        (arm(site=""), "the end effector is the centre of mass of body 'link2', as it has no site"),
        (arm(site="", tip=FINGERS, actuators=PULL, end=SPLIT), "the end effector is the middle of its gripper"),
        (arm(site='<site pos="0 0 0.3"/>'), "the end effector is its site 'site0'"),
        (arm(end='<equality><joint joint1="j2" joint2="j1"/></equality>'), "an equality ties joint 'j2' of the arm"),
        (arm().replace(MOTOR.format(i=1), ""), "joint 'j1' of the arm has no actuator and moves as it will"),
    ],
)
def test_what_is_guessed_is_one_line(xml, guess, write):
    (line,) = [line for line in read_arm(load_robot(write(xml))).guesses if guess in line]
    assert "\n" not in line


def test_everything_without_names_has_some(write):
    unnamed = arm(joint='<joint axis="{axis}" range="-2 2"/>', motor="", site="<site/>")
    spec = load_robot(write(unnamed))
    assert [joint.name for joint in spec.joints] == ["joint0", "joint1", "joint2"]
    assert [site.name for site in spec.sites] == ["site0"]


def test_a_command_prints_each_warning_once(capsys):
    """Also if a library has set up logging in its own way in between."""

    def main(arguments):
        logger = logging.getLogger("envs.somewhere")
        logger.warning("the %s is guessed", "site")
        logging.basicConfig()
        logger.warning("the site is guessed")
        logger.warning("the pose is guessed")
        logger.info("nobody wants to know")
        return 0

    with pytest.raises(SystemExit):
        run_command(main)
    assert capsys.readouterr().err == "the site is guessed\nthe pose is guessed\n"


def test_a_keyframe_that_is_too_short_is_noted(write):
    _, values, error = survey(write(arm(end='<keyframe><key name="home" qpos="1 1"/></keyframe>')), "json=true")
    assert "keyframe 'home' has 2 of 3 positions; the others are those of the initial pose, qpos0" in values["notes"]
    assert [joint["rest"] for joint in values["joints"]] == [1, 1, 0]
    assert error == ""


@published.each_robot
def test_published_robots_pass(name):
    """Arms with one command to train them; two arms with a line to choose one; others as what they are."""
    if name.endswith("/scene.xml"):
        pytest.skip("the same robot on a floor")
    path = published.FOLDER / name
    status, values, error = survey(str(path), "json=true")
    if name.startswith("aloha/"):
        assert status == 2
        assert "several arms of 6 joints, which end at left/gripper_link, right/gripper_link" in error
        return
    assert (status, error) == (0, "")
    task = {"unitree_go1": "walk", "bitcraze_crazyflie_2": "", "robotiq_2f85": ""}.get(name.partition("/")[0], "reach")
    task = "" if name.endswith("/hand.xml") else task
    assert values["task"] == task
    assert values["differences"] == []
    assert values["description"]["physics"] == "scalar"
    model = compile_model(load_robot(str(path)))
    assert [joint["name"] for joint in values["joints"]] == [model.joint(i).name for i in range(model.njnt)]
    assert bool(values["command"]) == (task in envs.REGISTRY)
    assert (values["base"] != "") == (mujoco.mjtJoint.mjJNT_FREE in model.jnt_type)

"""Controllers over a real socket, and a Universal Robots arm behind its package's functions."""

import contextlib
import socket
import sys
import threading
import time
import types

import numpy as np
import pytest

from smartview_jax.capture import (
    MoveRefusedError,
    SourceLostError,
    TcpRobot,
    UniversalRobot,
    controller_program,
    tcp_robot,
)
from smartview_jax.capture.tcp_robot import PROGRAMS
from smartview_jax.geometry import host_matrices, pose_codec

HOST, PATIENCE = "127.0.0.1", 30.0
START = (812.5, -20.1, 310.7, 90.02, -0.01, 179.98)


class Controller:
    """A controller that answers lines as the programs do, in KUKA's format."""

    def __init__(self):
        self.row, self.lines, self.refuse_after = np.array(START), [], None
        self.answers = {}
        self.listener = socket.create_server((HOST, 0))
        self.port = self.listener.getsockname()[1]
        self.thread = threading.Thread(target=self.serve, daemon=True)
        self.thread.start()

    def serve(self):
        while True:
            try:
                connection, _ = self.listener.accept()
            except OSError:
                return
            # The robot's side may close first.
            with connection, contextlib.suppress(OSError):
                self.talk(connection)

    def talk(self, connection):
        for raw in connection.makefile("rb"):
            line = raw.decode().strip()
            self.lines.append(line)
            answer = self.answers.get(line.split()[0], self.answer(line))
            if answer is None:
                return
            # In two parts, as a network may deliver it.
            connection.sendall(answer[:3].encode())
            connection.sendall(answer[3:].encode() + b"\r\n")

    def answer(self, line):
        if line == "pose":
            return "pose " + " ".join(f"{x:.4f}" for x in self.row)
        steps = sum(text.startswith("step") for text in self.lines)
        if self.refuse_after is not None and steps > self.refuse_after:
            return "error beyond a limit"
        self.row = np.array([float(word) for word in line.split()[1:7]])
        return "done"

    def close(self):
        self.listener.close()


@pytest.fixture
def controller():
    controller = Controller()
    yield controller
    controller.close()


@pytest.fixture
def robot(controller):
    robot = TcpRobot.connect(HOST, controller.port, "kuka_abc")
    yield robot
    robot.close()


def kuka_pose(row):
    codec = pose_codec("kuka_abc")
    return host_matrices(codec.decode(np.array([row]), *codec.units))[0]


def test_the_pose_is_read(robot):
    np.testing.assert_allclose(robot.pose(), kuka_pose(START), atol=1e-7)


def test_a_motion_is_many_steps_each_after_the_one_before(robot, controller):
    end = (842.5, -20.1, 330.7, 80.0, 0.0, 179.98)
    robot.move(kuka_pose(end), 0.05, threading.Event())
    np.testing.assert_allclose(robot.pose(), kuka_pose(end), atol=1e-6)
    steps = [line.split()[1:] for line in controller.lines if line.startswith("step")]
    assert len(steps) == 4
    assert {step[-1] for step in steps} == {"50.000"}


def test_a_stop_and_a_refusal_end_a_motion(robot, controller):
    end = kuka_pose((942.5, -20.1, 310.7, 90.02, -0.01, 179.98))
    stop = threading.Event()
    controller.refuse_after = 2
    with pytest.raises(MoveRefusedError, match="error beyond a limit"):
        robot.move(end, 0.05, stop)
    assert controller.row[0] == pytest.approx(812.5 + 20.0)
    stop.set()
    count = len(controller.lines)
    with pytest.raises(MoveRefusedError, match="stopped"):
        robot.move(end, 0.05, stop)
    assert controller.lines[count:] == ["pose"]


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ("pose 1 2 3", "expected 'pose' and 6 numbers"),
        ("pose a b c d e f", "expected 'pose' and 6 numbers"),
        ("pose nan 0 0 0 0 0", "NaN"),
        ("hello", "found 'hello'"),
        (None, "has closed the connection"),
        ("x" * 2000, "without a line end"),
    ],
)
def test_an_answer_that_is_none_is_a_lost_robot(controller, robot, answer, words):
    controller.answers["pose"] = answer
    with pytest.raises(SourceLostError, match=words):
        robot.pose()
    # The next connection works.
    controller.answers.clear()
    again = TcpRobot.connect(HOST, controller.port, "kuka_abc")
    robot.close()
    np.testing.assert_allclose(again.pose(), kuka_pose(START), atol=1e-7)
    again.close()


def test_a_late_answer_is_not_taken_for_the_next_one(controller, robot, monkeypatch):
    monkeypatch.setattr(tcp_robot, "TIMEOUT", 0.1)

    def late(line, answer=controller.answer):
        time.sleep(0.3)
        return answer(line)

    monkeypatch.setattr(controller, "answer", late)
    with pytest.raises(SourceLostError, match="does not answer"):
        robot.pose()
    with pytest.raises(SourceLostError):
        robot.pose()


def test_a_controller_that_connects_is_accepted(monkeypatch):
    with socket.create_server((HOST, 0)) as free:
        port = free.getsockname()[1]
    monkeypatch.setattr(tcp_robot, "TIMEOUT", 0.05)
    with pytest.raises(SourceLostError, match=f"no controller has connected to {HOST}:{port}"):
        TcpRobot.accept(HOST, port, "kuka_abc")
    monkeypatch.setattr(tcp_robot, "TIMEOUT", PATIENCE)
    accepted = []
    thread = threading.Thread(
        target=lambda: accepted.append(TcpRobot.accept(HOST, port, "kuka_abc"))
    )
    thread.start()
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            connection = socket.create_connection((HOST, port), PATIENCE)
            break
        except OSError:
            assert time.monotonic() < deadline
            time.sleep(0.01)
    with connection:
        thread.join(PATIENCE)
        talker = threading.Thread(
            target=lambda: connection.sendall(b"pose 812.5 -20.1 310.7 90.02 -0.01 179.98\n")
        )
        talker.start()
        np.testing.assert_allclose(accepted[0].pose(), kuka_pose(START), atol=1e-7)
        talker.join(PATIENCE)
        accepted[0].close()


def test_nobody_at_the_address_is_a_lost_robot():
    with socket.create_server((HOST, 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(SourceLostError, match=f"{HOST}:{port} does not answer"):
        TcpRobot.connect(HOST, port, "kuka_abc")
    with pytest.raises(ValueError, match="ouija"):
        TcpRobot.connect(HOST, port, "ouija")


class FakeArm:
    """A Universal Robots arm behind the functions of `ur-rtde`."""

    def __init__(self):
        self.pose, self.goal, self.left, self.stopped = [0.4, 0.1, 0.3, 0.0, 3.14, 0.0], None, 0, []
        self.connected, self.refuses, self.short = True, False, 0.0

    def modules(self):
        arm = self

        class RTDEReceiveInterface:
            def __init__(self, host):
                if host == "nobody":
                    raise RuntimeError("timeout")

            isConnected = staticmethod(lambda: arm.connected)
            getActualTCPPose = staticmethod(lambda: list(arm.pose))
            disconnect = staticmethod(lambda: None)

        class RTDEControlInterface(RTDEReceiveInterface):
            def moveL(self, pose, speed, acceleration, asynchronous):  # noqa: N802
                assert asynchronous
                assert (speed, acceleration) == (0.05, 0.25)
                arm.goal, arm.left = pose, 3
                return not arm.refuses

            def getAsyncOperationProgress(self):  # noqa: N802
                arm.left -= 1
                if arm.left < 0:
                    arm.pose = [arm.goal[0] - arm.short, *arm.goal[1:]]
                return arm.left

            stopL = staticmethod(arm.stopped.append)
            stopScript = staticmethod(lambda: None)

        return {
            "rtde_receive": types.SimpleNamespace(RTDEReceiveInterface=RTDEReceiveInterface),
            "rtde_control": types.SimpleNamespace(RTDEControlInterface=RTDEControlInterface),
        }


@pytest.fixture
def arm(monkeypatch):
    arm = FakeArm()
    for name, module in arm.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    return arm


def ur_pose(row):
    codec = pose_codec("ur")
    return host_matrices(codec.decode(np.array([row]), *codec.units))[0]


def test_a_universal_robot_reports_moves_and_stops(arm):
    robot, goal = UniversalRobot("192.168.0.10"), [0.45, 0.1, 0.35, 0.1, 3.0, 0.0]
    np.testing.assert_allclose(robot.pose(), ur_pose(arm.pose), atol=1e-12)
    robot.move(ur_pose(goal), 0.05, threading.Event())
    np.testing.assert_allclose(robot.pose(), ur_pose(goal), atol=1e-9)
    stop = threading.Event()
    stop.set()
    with pytest.raises(MoveRefusedError, match="stopped"):
        robot.move(ur_pose(goal), 0.05, stop)
    arm.short = 0.004
    with pytest.raises(MoveRefusedError, match=r"stopped 4\.0 mm from the pose"):
        robot.move(ur_pose(goal), 0.05, threading.Event())
    arm.refuses = True
    with pytest.raises(MoveRefusedError, match="refuses the motion"):
        robot.move(ur_pose(goal), 0.05, threading.Event())
    arm.connected = False
    with pytest.raises(SourceLostError, match="has closed the connection"):
        robot.pose()
    robot.close()


def test_a_stop_on_the_way_reaches_the_controller(arm):
    robot, stop = UniversalRobot("192.168.0.10"), threading.Event()
    robot.move(ur_pose(arm.pose), 0.05, threading.Event())
    real = robot._control.getAsyncOperationProgress

    def stop_on_the_way():
        stop.set()
        return real()

    robot._control.getAsyncOperationProgress = stop_on_the_way
    with pytest.raises(MoveRefusedError, match="stopped"):
        robot.move(ur_pose([0.5, 0.1, 0.3, 0.0, 3.14, 0.0]), 0.05, stop)
    assert arm.stopped == [2.0]


def test_without_an_arm_or_its_package_the_message_says_what_to_do(arm, monkeypatch):
    with pytest.raises(SourceLostError, match="nobody does not answer: timeout"):
        UniversalRobot("nobody")
    monkeypatch.setitem(sys.modules, "rtde_receive", None)
    with pytest.raises(ImportError, match=r"pip install 'smartview-jax\[ur\]'"):
        UniversalRobot("192.168.0.10")


@pytest.mark.parametrize("name", sorted(PROGRAMS))
def test_a_program_says_how_it_is_started_and_what_it_answers(name):
    text = controller_program(name)
    for words in ("smartview capture FOLDER --robot", "pose", "step", "done"):
        assert words in text
    with pytest.raises(ValueError, match="program is one of krl"):
        controller_program("ouija")


def test_the_node_of_ros_answers_as_the_protocol_says(monkeypatch):
    """With ROS's own modules replaced: they are the user's, not of this package."""
    vector = types.SimpleNamespace(x=0.4, y=0.1, z=0.3)
    turn = types.SimpleNamespace(x=0.0, y=1.0, z=0.0, w=0.0)
    transform = types.SimpleNamespace(translation=vector, rotation=turn)
    found = types.SimpleNamespace(transform=transform)

    class Node:
        def __init__(self, name):
            pass

        def declare_parameter(self, name, value):
            return types.SimpleNamespace(value=value)

    class Buffer:
        def lookup_transform(self, base, tool, when):
            assert (base, tool) == ("base_link", "tool0")
            return found

    modules = {
        "rclpy": types.SimpleNamespace(),
        "rclpy.node": types.SimpleNamespace(Node=Node),
        "rclpy.time": types.SimpleNamespace(Time=object),
        "tf2_ros": types.SimpleNamespace(
            Buffer=Buffer, TransformException=KeyError, TransformListener=lambda *_: None
        ),
    }
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    space = {"__name__": "ros2_node"}
    exec(compile(controller_program("ros2"), "ros2_node.py", "exec"), space)
    node = space["PoseNode"]()
    assert node.answer("pose") == "pose 0.4 0.1 0.3 0.0 1.0 0.0 0.0"
    assert node.answer("step 0 0 0 0 0 0 1 50").startswith("error")
    assert node.answer("") == "error unknown line"

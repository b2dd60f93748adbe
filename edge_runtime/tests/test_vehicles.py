"""The door of the drivers: built in, installed by others, or named as module:Class; and `drive`."""

import math
import sys
import threading
import time
from typing import Any, cast

import msgspec
import pytest
from hil_tests.processes import wait_until
from hil_tests.testing.commands import run_command
from hil_tests.testing.edge import Simulator
from hil_tests.testing.messages import make_state
from hil_tests.testing.vehicles import CAR, BrokenVehicle, a_manifest

import edge_runtime
from edge_runtime.config import BUILT_IN
from edge_runtime.controller import ActionLimit
from edge_runtime.reach import free_endpoint
from edge_runtime.util import UserError
from edge_runtime.vehicles import find_vehicle, installed_as, make_vehicle, vehicle_limits
from edge_runtime.vehicles.mock import MockVehicle

MODULE = """
from edge_runtime.vehicles.base import Vehicle
from edge_runtime.vehicles.mock import MockVehicle

class Cart(MockVehicle):
    name = "cart"
    arguments_of = classmethod(Vehicle.arguments_of.__func__)  # no settings of the mock
    def __init__(self, wheels=4, port=""):
        super().__init__()
        self.wheels = wheels
        if port:
            raise OSError(2, "no such port")

class Half(Vehicle):
    def enable(self, now_s): ...

class Boundless(Cart):
    limits = {"pedal": (-1.0, 1.0)}  # no ActionLimit

class Exits(Cart):
    def __init__(self):
        raise SystemExit(0)

class Raises(Cart):
    @property
    def limits(self):
        raise OSError("not connected")

class Unknown(Cart):
    @classmethod
    def limits_of(cls, settings, manifest):
        return None

number = 3
"""


@pytest.fixture(autouse=True)
def carts(tmp_path, monkeypatch):
    """A package of somebody else's on the path, with an entry point."""
    (tmp_path / "carts.py").write_text(MODULE)
    (tmp_path / "broken_cart.py").write_text("import nowhere_to_be_found")
    about = tmp_path / "carts-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: carts\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[phil.vehicles]\nmilk_cart = carts:Cart\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("carts", None)


WHOLE = msgspec.structs.asdict(CAR)


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        ("tank", {}, r"'tank' is not known; choose from none, mock, hunter, ros2, milk_cart, or a"),
        ("nowhere:Cart", {}, "'nowhere:Cart' cannot be loaded: .*No module named 'nowhere'"),
        ("broken_cart:Cart", {}, "cannot be loaded: .*nowhere_to_be_found"),
        ("carts:Wagon", {}, "cannot be loaded: .*Wagon"),
        ("carts:", {}, "cannot be loaded"),
        ("carts:number", {}, "carts:number is no edge_runtime.vehicles.base.Vehicle"),
        ("carts:Half", {}, "no whole Vehicle: it lacks brake, close, command, feedback"),
        ("carts:Boundless", {}, "cart: its limits must be like {'pedal': ActionLimit.*not {"),
        ("carts:Exits", {}, "carts:Exits cannot be opened: SystemExit"),
        ("carts:Raises", {}, "cart cannot be opened: OSError: not connected"),
        ("milk_cart", {"speed": 3}, "settings of cart: .*'speed'; known are wheels, port"),
        ("milk_cart", {"port": "ttyS9"}, "milk_cart cannot be opened: .*no such port"),
        ("mock", {"mass": 3}, "vehicle.mock: .*unknown field `mass`; known are dead_time_s"),
        ("mock", {"time_constant_s": 0.0}, "vehicle.mock.: time_constant_s 0.0 .*above 0"),
        ("mock", {"slew_per_s": -1.0}, "slew_per_s -1.0 .*above 0"),
        ("mock", {"dead_time_s": float("inf")}, "dead_time_s inf .*above 0"),
        ("hunter", {"speed": 3}, "vehicle.hunter: .*unknown field `speed`; known are model, scale"),
        ("hunter", {"bus": "can0"}, "bus 'can0'.*INTERFACE:CHANNEL"),
        ("hunter", {"model": "3.0"}, "vehicle.hunter.model '3.0'.*2.0, se"),
        ("hunter", {"profile": "v9"}, "vehicle.hunter.profile 'v9'.*v2, manual"),
        ("hunter", {"scale": 0.0}, "scale 0.0.*above 0"),
        ("hunter", {"scale": float("nan")}, "scale nan.*above 0"),
        ("hunter", {"car": {"throttle_mps2": 1.0}}, "vehicle.hunter.car: .*brake_mps2"),
        ("hunter", {"car": {**WHOLE, "mass": 1.0}}, "vehicle.hunter.car: .*unknown field `mass`"),
        ("hunter", {"car": {**WHOLE, "full_steering_rad": 2.0}}, "2.0 is not valid: .*below 1.5"),
        ("ros2", {"topic": 1}, "vehicle.ros2: .*unknown field `topic`; known are .*listen,"),
        ("ros2", {"connect": "tls/h:1"}, "plain text"),
        ("ros2", {"listen": "tcp/h:1", "connect": "tcp/h:1"}, "give one of them"),
        ("ros2", {"connect": "nowhere"}, "endpoint 'nowhere'"),
        ("ros2", {"twist_topic": ""}, "no topic to command by"),
        ("ros2", {"odometry_topic": ""}, "no odometry_topic"),
        ("ros2", {"odometry_topic": "/cmd_vel"}, "a topic twice: cmd_vel, cmd_vel"),
        ("ros2", {"twist_topic": "a b"}, "topic 'a b'"),
        ("ros2", {"namespace": "9"}, "namespace '9'"),
        ("ros2", {"twist_angular": "degrees"}, "yaw_rate, steering"),
    ],
)
def test_what_is_no_driver_or_no_setting_of_it_is_one_line(name, settings, words):
    table = "cart" if ":" in name else name
    for read in (make_vehicle, *([vehicle_limits] if name in BUILT_IN else [])):
        with pytest.raises(UserError, match=f"^.*{words}.*$"):  # a dot is no new line
            read(name, {table: settings}, a_manifest())


def test_the_limits_are_known_without_opening_anything():
    opens = {"milk_cart": {"port": "ttyS9"}, "hunter": {"bus": "socketcan:nowhere"}}
    for name, settings in opens.items():
        assert vehicle_limits(name, {name: settings}, a_manifest())
    with pytest.raises(UserError, match="settings of cart"):
        vehicle_limits("milk_cart", {"milk_cart": {"speed": 3}}, a_manifest())


@pytest.mark.parametrize(
    "limit",
    [
        (math.nan, 1.0), (-1.0, math.inf), (None, 1.0), ("-1", 1.0), (1.0, -1.0), (True, 1.0),
        (-1.0, 1.0, math.nan), (-1.0, 1.0, None), (-1.0, 1.0, -2.0), (-1.0, 1.0, 0.0),
    ],
)  # fmt: skip
def test_limits_that_bound_nothing_are_refused_wherever_they_are_read(limit, monkeypatch):
    find_vehicle("carts:Cart")
    monkeypatch.setattr(sys.modules["carts"].Cart, "limits", {"pedal": ActionLimit(*limit)})
    for read in (make_vehicle, vehicle_limits):
        with pytest.raises(UserError, match="limits"):
            read("carts:Cart", {}, a_manifest())
    with pytest.raises(UserError, match="limits"):
        vehicle_limits("carts:Unknown", {}, a_manifest())


def test_a_driver_of_another_package_gets_its_own_table():
    tables = {"milk_cart": {"wheels": 3}, "cart": {"wheels": 2}, "other": {"speed": 1}}
    for name, wheels in (("milk_cart", 3), ("carts:Cart", 2)):
        vehicle: Any = make_vehicle(name, tables, a_manifest())
        assert (vehicle.name, vehicle.wheels) == ("cart", wheels)
        assert vehicle_limits(name, tables, a_manifest()) == MockVehicle.limits
    assert find_vehicle("carts:Cart").name == "cart"
    # A recording has the name that it calls itself by.
    assert (installed_as("cart"), installed_as("mock")) == ("milk_cart", "mock")
    assert vehicle_limits("none", tables, a_manifest()) == {}


@pytest.mark.parametrize(
    ("name", "table", "own"),
    [("hunter", "Hunter", "hunter"), ("hunter", "huntr", "hunter"), ("carts:Cart", "crt", "cart")],
)
def test_a_misspelt_table_leaves_no_cap_at_its_default(name, table, own):
    words = rf"\[vehicle.{table}\] is no table of {name}; did you mean \[vehicle.{own}\]"
    for asked in (make_vehicle, vehicle_limits):
        with pytest.raises(UserError, match=words):
            asked(name, {table: {"scale": 0.05}, "mock": {}}, a_manifest())
    # Somebody else's, who is not asked for and not installed here, may stand beside it.
    assert vehicle_limits("mock", {table: {}}, a_manifest()) == MockVehicle.limits


def test_a_robot_follows_the_manifests_car_or_that_of_the_settings():
    for name in ("hunter", "ros2"):
        known = vehicle_limits(name, {}, a_manifest(CAR))
        assert known == vehicle_limits(name, {name: {"car": WHOLE}}, a_manifest())
        assert known != vehicle_limits(name, {}, a_manifest())
        with pytest.raises(UserError, match=rf"'parking'.* set car in \[vehicle.{name}\]"):
            vehicle_limits(name, {}, a_manifest(None))


def test_drive_from_python_moves_a_driver_until_it_is_told_to_end(make_policy, capsys):
    signed, endpoint, until = make_policy(value=1.0), free_endpoint(), threading.Event()

    class EmptyVehicle(BrokenVehicle):
        def __len__(self):  # Of its passengers, say: it is a driver all the same.
            return 0

    vehicle, ended = EmptyVehicle(), []
    settings = {"public_key": str(signed.public_key), "vehicle_id": "cart7", "log_level": "error"}

    def drive():
        call = edge_runtime.drive(
            signed.path, connect=endpoint, vehicle=vehicle, until=until, **settings
        )
        ended.append(call)

    thread = threading.Thread(target=drive)
    with Simulator(endpoint, "cart7") as simulator:
        thread.start()
        simulator.wait_for_edge()
        assert simulator.query("status")["vehicle"] == "mock"
        for step in range(20):
            simulator.ask(make_state(step))
            time.sleep(0.05)
        wait_until(lambda: vehicle.feedback(time.monotonic()).speed_mps > 0.1, "it to move")
        until.set()
        thread.join(20.0)
    assert (ended, "close" in vehicle.asked) == ([True], True)
    assert "ready vehicle_id=cart7 vehicle=mock" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"speed": 3}, "unknown field `speed`; known are policy, connect"),
        ({"cpus": "all"}, "cpus: Expected `array`"),
        ({"vehicle": "tank"}, "'tank' is not known"),
        ({}, "absent.onnx does not exist"),
    ],
)
def test_drive_refuses_what_run_refuses_and_closes_the_driver(settings, words, tmp_path):
    vehicle = BrokenVehicle()
    with pytest.raises(UserError, match=words):
        edge_runtime.drive(tmp_path / "absent.onnx", **{"vehicle": vehicle, **settings})
    assert vehicle.asked == ["close"] * ("vehicle" not in settings)
    vehicle.limits = None  # type: ignore[assignment]
    for wrong, words in (
        (BrokenVehicle, "is no edge_runtime.vehicles.base.Vehicle"),
        (vehicle, "limits"),
    ):
        with pytest.raises(UserError, match=words):
            edge_runtime.drive(tmp_path / "absent.onnx", vehicle=cast(Any, wrong))
    with pytest.raises(AttributeError, match="no attribute 'drivee'"):
        _ = edge_runtime.drivee


def test_a_module_on_the_path_drives_a_run(make_policy, carts):
    (carts / "edge.toml").write_text("[vehicle]\ndriver = 'carts:Cart'\n[vehicle.cart]\nmass = 1\n")
    ended = run_command("run", *make_policy().flags, "--config", "edge.toml", cwd=carts)
    words = "error: settings of cart: got an unexpected keyword argument 'mass'; known are wheels"
    assert (ended.returncode, ended.stderr) == (2, f"{words}, port\n")

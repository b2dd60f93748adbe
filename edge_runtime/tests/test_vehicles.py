"""The door of the drivers: built in, installed by others, or named as module:Class; and `drive`."""

import math
import sys
import threading
import time
from typing import Any

import msgspec
import pytest
from hil_tests.processes import wait_until
from hil_tests.tests.shared.drives import Simulator
from hil_tests.tests.shared.messages import make_state

import edge_runtime
from edge_runtime.config import BUILT_IN
from edge_runtime.controller import ActionLimit
from edge_runtime.reach import free_endpoint
from edge_runtime.tests.rigs import CAR, BrokenVehicle, a_manifest
from edge_runtime.util import UserError
from edge_runtime.vehicles import find_vehicle, make_vehicle, vehicle_limits
from edge_runtime.vehicles.mock import MockVehicle

MODULE = """
from edge_runtime.vehicles.base import Vehicle
from edge_runtime.vehicles.mock import MockVehicle

class Cart(MockVehicle):
    name = "cart"
    open = classmethod(Vehicle.open.__func__)  # no settings of the mock
    limits_of = classmethod(Vehicle.limits_of.__func__)

    def __init__(self, wheels=4, port=""):
        super().__init__()
        self.wheels = wheels
        if port:
            raise OSError(2, "no such port")

class Half(Vehicle):
    def enable(self, now_s): ...

class Exits(Cart):
    def __init__(self):
        raise SystemExit(0)

class Raises(Cart):
    @property
    def limits(self):
        raise OSError("not connected")
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
        ("tank", {}, "'tank' is not known; choose from none, mock, hunter, ros2, milk_cart"),
        ("broken_cart:Cart", {}, "nowhere_to_be_found"),
        ("carts:Wagon", {}, "Wagon"),
        ("carts:Half", {}, "brake'?, '?close'?, '?command'?, '?feedback"),
        ("carts:Exits", {}, "SystemExit"),
        ("carts:Raises", {}, "not connected"),
        ("milk_cart", {"speed": 3}, "'speed'"),
        ("milk_cart", {"port": "ttyS9"}, "no such port"),
        ("mock", {"time_constant_s": 0.0}, "time_constant_s 0.0"),
        ("hunter", {"bus": "can0"}, "bus 'can0'"),
        ("hunter", {"model": "3.0"}, "model '3.0'"),
        ("hunter", {"scale": float("nan")}, "scale"),
        ("hunter", {"car": {"throttle_mps2": 1.0}}, "brake_mps2"),
        ("hunter", {"car": {**WHOLE, "full_steering_rad": 2.0}}, "full_steering_rad"),
        ("ros2", {"connect": "tls/h:1"}, "plain text"),
        ("ros2", {"listen": "tcp/h:1", "connect": "tcp/h:1"}, "listen and connect"),
        ("ros2", {"odometry_topic": ""}, "''"),
        ("ros2", {"twist_angular": "degrees"}, "yaw_rate, steering"),
    ],
)
def test_what_is_no_driver_or_no_setting_of_it_is_one_line(name, settings, words):
    table = "cart" if ":" in name else name
    reads: list = [make_vehicle, vehicle_limits] if name in BUILT_IN else [make_vehicle]
    for read in reads:
        with pytest.raises(UserError, match=f"^.*{words}.*$"):  # a dot is no new line
            read(name, {table: settings}, a_manifest())


@pytest.mark.parametrize(
    "limit",
    [
        (math.nan, 1.0), (-1.0, math.inf), (None, 1.0), (1.0, -1.0), (-1.0, 1.0, math.nan),
        (-1.0, 1.0, 0.0),
    ],
)  # fmt: skip
def test_limits_that_bound_nothing_are_refused_wherever_they_are_read(limit, monkeypatch):
    find_vehicle("carts:Cart")
    for limits in ({"pedal": ActionLimit(*limit)}, {"pedal": limit}, {}, None):
        monkeypatch.setattr(sys.modules["carts"].Cart, "limits", limits)
        for read in (make_vehicle, vehicle_limits):
            with pytest.raises(UserError, match="limits"):
                read("carts:Cart", {}, a_manifest())


def test_a_driver_of_another_package_gets_its_own_table_and_its_limits_open_nothing():
    tables = {"milk_cart": {"wheels": 3}, "cart": {"wheels": 2}, "other": {"speed": 1}}
    for name, wheels in (("milk_cart", 3), ("carts:Cart", 2)):
        vehicle: Any = make_vehicle(name, tables, a_manifest())
        assert (vehicle.name, vehicle.wheels) == ("cart", wheels)
    assert vehicle_limits("none", tables, a_manifest()) == {}
    shut = {"milk_cart": {"port": "ttyS9"}, "hunter": {"bus": "socketcan:nowhere"}}
    assert vehicle_limits("milk_cart", shut, a_manifest()) == MockVehicle.limits
    assert vehicle_limits("hunter", shut, a_manifest())


@pytest.mark.parametrize(("name", "table"), [("hunter", "huntr"), ("carts:Cart", "crt")])
def test_a_misspelt_table_leaves_no_cap_at_its_default(name, table):
    for asked in (make_vehicle, vehicle_limits):
        with pytest.raises(UserError, match=table):
            asked(name, {table: {"scale": 0.05}, "mock": {}}, a_manifest())
    # Somebody else's, who is not asked for and not installed here, may stand beside it.
    assert vehicle_limits("mock", {table: {}}, a_manifest()) == MockVehicle.limits


@pytest.mark.parametrize("name", ["hunter", "ros2"])
def test_a_robot_follows_the_manifests_car_or_that_of_the_settings(name):
    known = vehicle_limits(name, {}, a_manifest(CAR))
    assert known == vehicle_limits(name, {name: {"car": WHOLE}}, a_manifest())
    assert known != vehicle_limits(name, {}, a_manifest())
    with pytest.raises(UserError, match="'parking'"):
        vehicle_limits(name, {}, a_manifest(None))


def test_drive_from_python_moves_a_driver_until_it_is_told_to_end(make_policy):
    signed, endpoint, until = make_policy(value=1.0), free_endpoint(), threading.Event()

    class EmptyVehicle(BrokenVehicle):
        def __len__(self):  # Of its passengers, say: it is a driver all the same.
            return 0

    vehicle = EmptyVehicle()
    settings = {"public_key": str(signed.public_key), "vehicle_id": "cart7", "until": until}
    thread = threading.Thread(
        target=edge_runtime.drive,
        args=(signed.path,),
        kwargs={"connect": endpoint, "vehicle": vehicle, **settings},
    )
    with Simulator(endpoint, "cart7") as simulator:
        thread.start()
        simulator.wait_for_edge()
        assert simulator.query("status")["vehicle"] == "mock"
        for step in range(20):
            simulator.ask(make_state(step))
            time.sleep(0.05)
        wait_until(lambda: "command" in vehicle.asked, "it to be driven")
        until.set()
        thread.join(20.0)
    assert "close" in vehicle.asked


def test_a_driver_that_keeps_the_bounds_for_itself_is_refused(make_policy):
    class Loose(BrokenVehicle):
        def take_bounds(self, bounds):
            self.most_mps = bounds.max_speed_mps

    signed, vehicle = make_policy(), Loose()
    key, connect = str(signed.public_key), free_endpoint()
    with pytest.raises(UserError, match="take_bounds"):
        edge_runtime.drive(
            signed.path, connect=connect, vehicle=vehicle, leash_m=1.0, public_key=key
        )
    assert vehicle.asked == ["close"]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"speed": 3}, "unknown field `speed`"),
        ({"vehicle": "tank"}, "'tank' is not known"),
        ({"vehicle": BrokenVehicle}, "is no edge_runtime.vehicles.base.Vehicle"),
        ({}, "absent.onnx does not exist"),
    ],
)
def test_drive_refuses_what_run_refuses_and_closes_the_driver(settings, words, tmp_path):
    vehicle = BrokenVehicle()
    with pytest.raises(UserError, match=words):
        edge_runtime.drive(tmp_path / "absent.onnx", **{"vehicle": vehicle, **settings})
    assert vehicle.asked == ["close"] * ("vehicle" not in settings)

"""The mock chassis. Its frames are written by hand: to agree with our codec proves little."""

import pytest

from edge_runtime.vehicles.hunter.protocol import WheelMotion
from hil_tests.faults.rig import Chassis, free_bus
from hil_tests.mock_hunter import BITS, MODELS, MockHunter

P = MODELS["hunter-2.0"]


CAN_MODE, STANDBY = (0x421, b"\x01"), (0x421, b"\x00")
RELEASE, LOCK = (0x131, b"\x00"), (0x131, b"\x01")
CLEAR = (0x441, b"\x00")
SLOW_AHEAD = (0x111, bytes.fromhex("00 96 00 00 00 00 00 00"))  # 0.15 m/s, golden
FAST_AHEAD = (0x111, bytes.fromhex("03 E8 00 00 00 00 00 00"))  # 1.0 m/s
TURNED = (0x111, bytes.fromhex("00 00 00 00 00 00 00 C8"))  # 0.2 rad, golden
STOP = (0x111, bytes(8))

FAULT_BITS = {  # byte, bit: from the facts, not from the driver
    "steering_encoder": (4, 1), "remote_lost": (4, 2), "driver": (4, 6), "undervoltage": (5, 0),
    "link_steer": (5, 3), "link_rear_right": (5, 4), "link_rear_left": (5, 5),
    "overtemperature": (5, 6), "overcurrent": (5, 7),
}  # fmt: skip


class Bench:
    """A mock with a clock of its own, polled every 5 ms."""

    def __init__(self, *frames):
        self.now_s = 100.0
        self.hunter = MockHunter(P, self.now_s)
        self.seen = []
        self.send(*frames)

    def send(self, *frames):
        for can_id, data in frames:
            self.hunter.receive(can_id, data, self.now_s)

    def run(self, seconds, frame=None):
        """Let time pass; with a frame, it is streamed at 50 Hz."""
        for step in range(round(seconds / 0.005)):
            if frame is not None and step % 4 == 0:
                self.send(frame)
            self.now_s = round(self.now_s + 0.005, 6)
            if self.now_s >= self.hunter.next_s:
                due = self.hunter.due(self.now_s)
                self.seen += [(self.now_s, frame.can_id, data) for frame, data in due]
        return self

    def switch(self, name, on=True):
        self.hunter.switch(name, on, self.now_s)

    def sent(self, can_id):
        return [data for _, sent_id, data in self.seen if sent_id == can_id]

    @property
    def stands(self):
        return self.hunter.stands

    @property
    def status(self):
        return self.sent(0x211)[-1]


def enabled(frame=FAST_AHEAD, seconds=2.0):
    return Bench(CAN_MODE, RELEASE).run(seconds, frame)


@pytest.mark.parametrize("frame", [SLOW_AHEAD, TURNED])
def test_the_documented_start_moves_it_by_the_golden_frames(frame):
    first = Bench().run(0.05).status
    # ok, standby, some 28.0 V, no fault, brake locked, the first one counted.
    assert (first[:2], first[4:]) == (b"\x00\x00", b"\x00\x00\x01\x00")
    assert 270 <= int.from_bytes(first[2:4], "big") <= 280
    bench = enabled(frame)
    assert (bench.status[1], bench.status[6]) == (1, 0)
    assert bench.sent(0x221)[-1] == frame[1]


@pytest.mark.parametrize(
    "frames",
    [(CAN_MODE,), (RELEASE,), (CAN_MODE, RELEASE, LOCK), (CAN_MODE, RELEASE, STANDBY)],
)
def test_short_of_the_whole_start_nothing_moves(frames):
    assert Bench(*frames).run(1.0, FAST_AHEAD).stands


def test_periods_are_kept_on_absolute_deadlines_and_after_a_pause_it_reports_once():
    bench = enabled()
    periods_s = dict.fromkeys((0x211, 0x261, 0x262, 0x263), 0.1)
    periods_s |= dict.fromkeys((0x221, 0x251, 0x252, 0x253), 0.02)
    assert {sent_id for _, sent_id, _ in bench.seen} == set(periods_s)
    for can_id, period_s in periods_s.items():
        times = [at for at, sent_id, _ in bench.seen if sent_id == can_id]
        assert len(times) == pytest.approx(2.0 / period_s, abs=1)
        assert times[-1] - times[0] == pytest.approx((len(times) - 1) * period_s, abs=0.006)
    sent = bench.hunter.due(bench.hunter.next_s + 1.013)
    assert len({frame.can_id for frame, _ in sent}) == len(sent)


def test_without_commands_it_stands_by_and_drives_on_by_itself_when_they_come_back():
    bench = enabled()
    assert not bench.run(0.45).stands
    bench.run(0.15)
    assert (bench.status[1], bench.status[4]) == (0, 1 << 4)
    assert bench.run(1.0).stands
    assert bench.run(1.0, FAST_AHEAD).hunter.speed_mps > 0.8
    assert (bench.status[1], bench.status[4:6]) == (1, b"\x00\x00")


@pytest.mark.parametrize("name", BITS)
def test_each_error_by_hand_stops_and_goes_as_its_row_says(name):
    bench, row = enabled(), BITS[name]
    bench.switch(name)
    bench.run(1.0, FAST_AHEAD)
    data, (byte, bit) = bench.status, FAULT_BITS[name]
    assert (data[byte], data[9 - byte]) == (1 << bit, 0)  # in one of bytes 4 and 5
    assert data[0] == (2 if row.stops else 0)
    assert bench.stands == row.stops
    bench.send(CLEAR)
    assert bench.hunter.errors == {name}  # the cause is still there
    bench.switch(name, on=False)
    assert bench.hunter.errors == ({name} if row.latches else set())
    assert bench.hunter.obeys == (not (row.latches and row.stops))
    bench.send(CLEAR)
    assert not bench.run(1.0, FAST_AHEAD).stands
    assert bench.status[4:6] == b"\x00\x00"


@pytest.mark.parametrize(
    ("name", "byte", "shown"), [("estop", 0, 1), ("remote", 1, 2), ("brake", 6, 1)]
)
def test_a_person_and_the_brake_outrank_the_bus_and_give_control_back(name, byte, shown):
    bench = enabled()
    bench.send(LOCK) if name == "brake" else bench.switch(name)
    bench.send(CAN_MODE)
    assert bench.run(0.75, FAST_AHEAD).stands
    assert bench.status[byte] == shown
    bench.send(RELEASE) if name == "brake" else bench.switch(name, on=False)
    assert not bench.run(0.5, FAST_AHEAD).stands


def test_as_a_process_it_obeys_orders_and_ends_on_a_signal():
    with Chassis(free_bus()) as chassis:
        for words in ("meteor on", "\udcff"):  # the second is no UTF-8
            chassis.tell(words)
            chassis.wait_for_line("is no order")
        chassis.switch("remote", True)
        chassis.wait_for_line("control=remote ")
    assert chassis.end() == 0


def test_a_person_drives_with_the_remote_control_alone_and_no_longer_than_it_has_control():
    bench = Bench()
    bench.hunter.sticks = WheelMotion(0.4, -0.2)
    assert bench.run(1.0).stands
    bench.switch("remote")
    bench.run(1.0)
    assert bench.hunter.speed_mps == pytest.approx(0.4, abs=0.01)
    assert bench.hunter.inner_rad == pytest.approx(-0.2, abs=0.01)
    bench.switch("estop")
    assert bench.run(1.0).stands
    bench.switch("estop", False)
    assert not bench.run(1.0).stands
    bench.switch("remote", False)
    assert bench.run(1.0).stands

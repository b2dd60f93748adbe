"""A Hunter's driver and the mock of its chassis on one bus, in virtual time: no process, no clock.

The driver's core (`edge_runtime/vehicles/hunter/core.py`) and the mock exchange the very frames
that they send over CAN, 50 times a second each way; a frame takes no time. Its phases are fixed:
in life the three clocks drift, and their mean is what stands here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from edge_runtime.vehicles.base import VehicleReport
from edge_runtime.vehicles.core import State
from edge_runtime.vehicles.hunter.core import HunterCore
from edge_runtime.vehicles.hunter.protocol import DEFAULT_PROFILE
from edge_runtime.vehicles.mapping import SPECS, Similarity, car_of, similarity_to
from edge_runtime.wire import TOPICS
from hil_tests.mock_hunter.hunter import MockHunter
from hil_tests.mock_hunter.parameters import Parameters

MODEL = "2.0"
STREAM_MS, STREAM_PHASE_MS = 20, 10
CHASSIS_MS = 20
FEEDBACK_MS = round(1000 / TOPICS["feedback"].rate_hz)
FEEDBACK_PHASE_MS = FEEDBACK_MS // 2
"""So the newest feedback at a tick is half a period old, as it is on average in life."""
STEP_MS = 5
READY_MS = 2000
ROUNDING_S = 1e-6
"""The mock adds its periods up: a time that is due may come out later by a rounding."""


class VirtualHunter:
    """The vehicle's side of the loop. Times are whole milliseconds from its switching on.

    Args:
        scenario: whose car it stands for.
        parameters: of the chassis.
    """

    def __init__(self, scenario: str, parameters: Parameters) -> None:
        spec = SPECS[MODEL]
        similarity = _similarity(scenario, spec.max_speed_mps)
        self.core = HunterCore(spec, DEFAULT_PROFILE, similarity)
        self.mock = MockHunter(parameters, 0.0, DEFAULT_PROFILE)
        self.now_ms = 0

    def enable(self) -> None:
        """Take control and wait until the chassis has confirmed it.

        Raises:
            RuntimeError: it does not, which is a fault of the driver or the mock.
        """
        self.core.enable(self.now_ms / 1e3)
        self.run(READY_MS)
        if self.core.state is not State.ENABLED:
            raise RuntimeError(f"not enabled: {self.core.report(self.now_ms / 1e3).faults}")

    def command(self, action: Mapping[str, float], scenario_speed_mps: float) -> None:
        """What the edge runtime asks now."""
        self.core.command(dict(action), self.now_ms / 1e3, scenario_speed_mps)

    def run(self, duration_ms: int) -> Sequence[tuple[int, VehicleReport]]:
        """Let time pass; the reports that go out as feedback meanwhile, each with its time."""
        reports = []
        for now_ms in range(self.now_ms, self.now_ms + duration_ms, STEP_MS):
            now_s = now_ms / 1e3 + ROUNDING_S
            if now_ms % CHASSIS_MS == 0:
                for wire in self.mock.due(now_s):
                    self.core.hear(wire.can_id, wire.data, now_s)
            if now_ms % STREAM_MS == STREAM_PHASE_MS:
                for sent in self.core.tick(now_s):
                    self.mock.receive(sent.frame.can_id, sent.data, now_s)
            if now_ms % FEEDBACK_MS == FEEDBACK_PHASE_MS:
                reports.append((now_ms, self.core.report(now_s)))
        self.now_ms += duration_ms
        return reports


def _similarity(scenario: str, max_speed_mps: float) -> Similarity:
    return similarity_to(car_of(scenario, "hunter"), max_speed_mps)

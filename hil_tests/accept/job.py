"""An acceptance: its thresholds, the rows of its report, and the drives that it judges by."""

from __future__ import annotations

import contextlib
import threading
from argparse import Namespace
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec

from bridge.environments import NOMINAL
from bridge.network import LatencySpec
from bridge.outcomes import GOAL, Estimate, success_estimate
from edge_runtime.config import NONE, Config, convert
from edge_runtime.policy import Policy
from edge_runtime.reach import free_endpoint
from edge_runtime.util import UserError, read_json, read_toml
from hil_tests.envelope import Drivers
from hil_tests.processes import Process, operate

DEFAULTS = Path(__file__).with_name("accept.toml")
PASSED, FAILED, NOT_TRIED = "passed", "failed", "not_tried"
VEHICLE_ID = "accept"
EPISODE_S, START_S = 120.0, 120.0  # At most, of a drive over the wire
_Count = Annotated[int, msgspec.Meta(ge=1)]
_Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
_Size = Annotated[float, msgspec.Meta(ge=0.0)]


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The keys of accept.toml, which explains them."""

    runs: _Count
    wire_runs: _Count
    drives: _Count
    vehicle_drives: _Count
    sweep_runs: _Count
    tries: _Count
    faults: list[str]
    inference_share: _Share
    round_trip_s: _Size
    success: dict[str, _Share]
    success_link: _Share
    success_vehicle: _Share
    margin_delay_ms: _Size
    margin_loss_percent: _Size
    recordings: list[str]
    edge: str
    board_command: str
    quick: dict[str, Any]


def load_settings(path: str | None, quick: bool) -> Settings:
    """Read a file over the defaults. UserError for an unknown key or a value out of range."""
    known, given = read_toml(DEFAULTS, "settings"), read_toml(path, "settings") if path else {}
    chosen = {**known, **given}
    if quick:
        chosen |= {**known["quick"], **given.get("quick", {})}
    try:
        return convert(chosen, Settings)
    except UserError as error:
        raise UserError(f"settings {path}: {error}") from None


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """A row of the report; ``data`` is what the page draws of it."""

    name: str
    asked: str = ""
    measured: str = ""
    result: str  # PASSED, FAILED or NOT_TRIED
    why: str = ""
    data: dict[str, Any] = {}

    @property
    def is_fault(self) -> bool:
        return self.name.startswith("fault ")


def judged(is_good: bool, name: str, asked: str, measured: str, why: str, **data: Any) -> Row:
    """Make a row that says why only where it failed."""
    result, why = (PASSED, "") if is_good else (FAILED, why)
    return Row(name=name, asked=asked, measured=measured, result=result, why=why, data=data)


def not_tried(name: str, why: str, asked: str = "") -> Row:
    return Row(name=name, asked=asked, result=NOT_TRIED, why=why)


@dataclass
class Job:
    """An acceptance under way. ``policy`` is None where it may not drive, which ``refusal`` tells.

    ``vehicle`` and ``config`` are those of ``--vehicle`` and the settings' edge.toml.
    """

    asked: Namespace
    settings: Settings
    folder: Path
    policy: Policy | None
    refusal: str
    config: Config

    @property
    def link(self) -> LatencySpec:
        return self.asked.link

    @property
    def period_s(self) -> float:
        assert self.policy is not None
        return self.policy.manifest.control_period_s

    @property
    def has_vehicle(self) -> bool:
        return self.config.vehicle != NONE

    @property
    def trust(self) -> list[str]:
        """The options of a command that reads the policy."""
        key = ["--public-key", self.asked.public_key] if self.asked.public_key else []
        return [*key, *["--allow-unsigned"] * bool(self.asked.allow_unsigned)]

    def vehicle_options(self, vehicle: bool = True) -> list[str]:
        """Return the options of a command that runs the vehicle, or none in its place."""
        edge = ["--config", self.settings.edge] if self.settings.edge else []
        return [*edge, "--vehicle", self.config.vehicle if vehicle else NONE]

    @contextlib.contextmanager
    def driving(self, condition: str = NOMINAL) -> Iterator[Callable[[LatencySpec, int], Estimate]]:
        """Give a function of a network and a number of drives: the success, in virtual time."""
        asked = self.asked
        with Drivers(asked.policy, asked.env, condition, asked.public_key, 0) as drivers:

            def share(spec: LatencySpec, runs: int) -> Estimate:
                results = drivers.drive(spec, range(runs))
                return success_estimate(sum(each.outcome == GOAL for each in results), runs)

            yield share

    def drive(
        self, episodes: int, *options: str, record: Path | None = None, vehicle: bool = False
    ) -> dict[str, Any]:
        """Drive over the wire, with the policy in an edge runtime; return the simulator's report.

        ``record`` is a recording to write. With the vehicle in the loop an operator re-arms it.
        """
        end, out, endpoint = threading.Event(), self.folder / "drive.json", free_endpoint()
        ends = ("--connect", endpoint, "--vehicle-id", VEHICLE_ID)
        simulate = ("bridge", "simulate", "--env", self.asked.env, "--episodes", str(episodes))
        where = ("--listen", endpoint, "--vehicle-id", VEHICLE_ID, "--period", str(self.period_s))
        run = ("edge_runtime", "run", "--policy", self.asked.policy, *self.trust, *ends)
        with contextlib.ExitStack() as stack:
            start = stack.enter_context
            simulator = start(Process(*simulate, *where, *options, "--out", str(out)))
            if record:
                record.unlink(missing_ok=True)
                words = ("bridge", "record", "--out", str(record), "--wait-s", str(START_S), *ends)
                recorder = start(Process(*words, ready="recording"))
            options_here = self.vehicle_options(vehicle)
            start(Process(*run, *options_here, ready="ready"))  # Last: the drive begins with it.
            if vehicle:
                operator = threading.Thread(target=operate, args=(endpoint, VEHICLE_ID, end))
                operator.start()
                stack.callback(operator.join)
                stack.callback(end.set)
            simulator.succeed(START_S + episodes * EPISODE_S)
            if record:
                recorder.end()
        return read_json(out, "report")

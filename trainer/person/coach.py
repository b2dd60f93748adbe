"""The coach: what a person's guidance has achieved, what is typical, and one line of advice.

The loop tells it of episodes and of validations of the policy alone; the page shows the rest.
"""

import json
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bridge.outcomes import failed
from edge_runtime.util import counted
from trainer.training.metrics import LEARNED as LEVELS
from trainer.training.metrics import is_reached

LEARNED, WELL = LEVELS
"""Success of the policy alone from which the person only watches, and from which all is done."""
RECENT = 10  # Episodes that are listed, and that the advice looks at
TOO_LATE_S = 2.0  # A failure so soon after a take-over says that it came too late
LATE_ONES = 3  # So many recent failures, alone or after a late take-over, make the coach say so
TYPICAL_FILE = Path(__file__).parent / "typical.json"
"""Curves of a scripted human's ordinary run; ``python -m trainer experiment typical`` makes it."""

Curve = list[tuple[float, float]]
"""Seconds that the human has driven -> success of the policy alone, 0 to 1."""


@dataclass(frozen=True)
class SittingEpisode:
    """One episode of a sitting."""

    number: int
    outcome: str
    human_s: float
    takeovers: int
    since_takeover_s: float = math.nan
    """From the last take-over's beginning to the episode's end; nan: there was none, or unknown."""


@dataclass(frozen=True)
class Coaching:
    """What the page shows of the coach."""

    advice: str  # Empty where there is none
    said: str  # What the person has given; empty where nothing learns
    alone: str  # Success of the policy alone, in words; empty before the first validation
    curve: Curve
    typical: Curve  # Of a scripted human with the same algorithm; empty where none is known
    human_s: float  # How far along the curves the person is
    episodes: list[SittingEpisode]  # The newest last


class Coach:
    """Collects what happens; it advises where something is ``learning``."""

    def __init__(self, typical: Curve | None = None, learning: bool = False) -> None:
        self.typical, self.learning = typical or [], learning
        self.episodes: deque[SittingEpisode] = deque(maxlen=RECENT)
        self.curve: Curve = []

    def show(self, cost: Mapping[str, float]) -> Coaching | None:
        """Return what to show; None where there is nothing yet. ``cost`` as ``Sitting.cost``."""
        if not self.learning and not self.episodes:
            return None
        given = (
            f"{cost['human_s']:.0f} s at the wheel, {counted(int(cost['takeovers']), 'take-over')},"
            f" {counted(int(cost['failures']), 'failure')}."
        )
        return Coaching(
            advice=advise(self.episodes, self.curve) if self.learning else "",
            said=given if self.learning else "",
            alone=f"{self.curve[-1][1]:.0%}" if self.curve else "",
            curve=[(round(x, 1), round(y, 3)) for x, y in self.curve],
            typical=self.typical,
            human_s=cost["human_s"],
            episodes=list(self.episodes),
        )


def advise(episodes: Sequence[SittingEpisode], curve: Curve) -> str:
    """Return one line of advice, by the first rule that fits; an empty text where none does."""
    alone = curve[-1][1] if curve else 0.0
    if is_reached(LEARNED, alone):
        what = "you may stop here" if is_reached(WELL, alone) else "watch only"
        return f"The policy alone reaches {alone:.0%}: {what}."
    late = sum(
        failed(one.outcome) and (not one.takeovers or one.since_takeover_s <= TOO_LATE_S)
        for one in episodes
    )
    if late < LATE_ONES:
        return ""
    return (
        f"Take over earlier: {late} of the last {len(episodes)} episodes failed without you, "
        f"or within {TOO_LATE_S:.0f} s of your taking over."
    )


def typical_curve(scenario: str, algorithm: str) -> Curve:
    """Return the curve of a scripted human's ordinary run; empty where none is known.

    The program that made the file from the experiments' records is in revision 2bbf9911.
    """
    known = json.loads(TYPICAL_FILE.read_text()).get(scenario, {}).get(algorithm, {})
    return [(human_s, success) for human_s, success in known.get("points", [])]

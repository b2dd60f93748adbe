"""The coach: what a person's guidance has achieved, what is typical, and one line of advice.

The loop tells it of episodes and of validations of the policy alone; the page shows the rest.
"""

import json
import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bridge.outcomes import failed
from edge_runtime.util import counted
from trainer.training.metrics import LEARNED as LEVELS
from trainer.training.metrics import is_reached, was_validated

LEARNED, WELL = LEVELS
"""Success of the policy alone from which the person only watches, and from which all is done."""
RECENT = 10  # Episodes that are listed, and that the advice looks at
TOO_LATE_S = 2.0  # A failure so soon after a take-over says that it came too late
LATE_ONES = 3  # So many recent failures, alone or after a late take-over, make the coach say so
NEEDLESS_ONES, NEEDLESS_SHARE = 3, 2.0 / 3.0
"""At least so many recent episodes with take-overs, and this share of them, must be mastered by the
policy alone, to say that the take-overs were needless."""
TYPICAL_FILE = Path(__file__).parent / "typical.json"

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

    @property
    def unattended(self) -> bool:
        """Whether it failed without the person, or too soon after a take-over."""
        late = not self.takeovers or self.since_takeover_s <= TOO_LATE_S
        return failed(self.outcome) and late


@dataclass(frozen=True)
class Coaching:
    """What the page shows of the coach."""

    advice: str  # Empty where there is none
    said: str  # What the person has given; empty where there is nothing to hold it against
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
        self.checking = False  # Whether the policy alone is being validated
        self._mastered: Mapping[int, bool] = {}

    def recall(self, rows: Iterable[Mapping[str, str]], period_s: float) -> None:
        """Take up what ``metrics.csv`` says of the run so far."""
        given_s = 0.0
        for row in rows:
            human_s = int(row["human_steps"]) * period_s
            given_s += human_s
            takeovers = int(row["interventions"])
            self.episodes.append(
                SittingEpisode(int(row["episode"]), row["outcome"], human_s, takeovers)
            )
            if was_validated(row):
                self.curve.append((given_s, float(row["validation_success"])))

    def to_check(self) -> list[int]:
        """List the recent episodes with take-overs: does the policy master them alone?"""
        return [episode.number for episode in self.episodes if episode.takeovers]

    def take(self, human_s: float, success: float, mastered: Mapping[int, bool]) -> None:
        """Take the validation of the policy as it stood when the person had driven ``human_s``.

        ``mastered``: an episode that was to be checked -> whether it reached the goal alone.
        """
        self.curve.append((human_s, success))
        self._mastered = mastered

    def show(self, cost: Mapping[str, float]) -> Coaching | None:
        """Return what to show; None where there is nothing yet. ``cost`` as ``Sitting.cost``."""
        if not self.learning and not self.episodes:
            return None
        alone = self.curve[-1][1] if self.curve else None
        known = ([] if alone is None else [f"{alone:.0%}"]) + ["checking"] * self.checking
        compared = bool(known or self.typical)
        episodes = list(self.episodes)
        return Coaching(
            advice=advise(episodes, alone, self._mastered) if self.learning else "",
            said=said(cost, self.curve, self.typical) if compared else "",
            alone=", ".join(known),
            curve=[(round(x, 1), round(y, 3)) for x, y in self.curve],
            typical=self.typical,
            human_s=cost["human_s"],
            episodes=episodes,
        )


def advise(
    episodes: Sequence[SittingEpisode], alone: float | None, mastered: Mapping[int, bool]
) -> str:
    """Return one line of advice, by the first rule that fits; an empty text where none does.

    ``alone``: newest success of the policy alone, 0 to 1; ``mastered``: episode -> whether the
    policy alone reaches the goal in it today.
    """
    if alone is not None and is_reached(LEARNED, alone):
        what = "you may stop here" if is_reached(WELL, alone) else "watch only"
        return f"The policy alone reaches {alone:.0%}: {what}."
    late = sum(episode.unattended for episode in episodes)
    if late >= LATE_ONES:
        return (
            f"Take over earlier: {late} of the last {len(episodes)} episodes failed without you, "
            f"or within {TOO_LATE_S:.0f} s of your taking over."
        )
    checked = [mastered[one.number] for one in episodes if one.takeovers and one.number in mastered]
    if sum(checked) >= max(NEEDLESS_ONES, NEEDLESS_SHARE * len(checked)):
        return (
            f"Let it go on for longer: alone, it masters {sum(checked)} of the last {len(checked)} "
            "episodes in which you took over."
        )
    return ""


def said(cost: Mapping[str, float], curve: Curve, typical: Curve) -> str:
    """Say what the person has given, and after how much of it the policy alone had learned,
    beside a scripted human.
    """
    given = (
        f"{cost['human_s']:.0f} s at the wheel, {counted(int(cost['takeovers']), 'take-over')}, "
        f"{counted(int(cost['failures']), 'failure')}."
    )
    there = [
        f"after {reached[0]:.0f} s of {who}"
        for who, points in (("you", curve), ("a scripted human", typical))
        if (reached := [human_s for human_s, success in points if is_reached(LEARNED, success)])
    ]
    return f"{given} The policy alone: {LEARNED:.0%} {', '.join(there)}." if there else given


def typical_curve(scenario: str, algorithm: str) -> Curve:
    """Return the curve of a scripted human's ordinary run; empty where none is known.

    ``python -m trainer experiment typical`` makes the file from the experiments' records.
    """
    known = json.loads(TYPICAL_FILE.read_text()).get(scenario, {}).get(algorithm, {})
    return [(human_s, success) for human_s, success in known.get("points", [])]

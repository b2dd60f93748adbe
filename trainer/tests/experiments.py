"""A small plan, a store in a temporary directory, and human models that are only files."""

from dataclasses import replace
from pathlib import Path

from trainer.experiments.plan import QUICK
from trainer.experiments.store import Store
from trainer.experiments.units import Unit, human_file

TINY = replace(QUICK, episodes={"left_turn": 3, "congestion": 3}, test_runs=2)
UNIT = Unit("left_turn", "per_td3", "normal", 1)
"""No human guides it: it can be computed anywhere."""
GUIDED = Unit("left_turn", "phil_td3", "normal", 1)


def store_in(directory: Path, plan=TINY) -> Store:
    return Store(plan, directory / "results", directory / "runs", directory / "humans")


def write_human(store: Store, data: bytes = b"a human", scenario: str = "left_turn") -> None:
    path = human_file(scenario, store.humans)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


class Soon(float):
    """A time that is still to come when it is first looked at, and over ever after."""

    looked = False

    def __lt__(self, other):
        looked, self.looked = self.looked, True
        return looked

"""What is kept under ``results/`` lies where it says that it belongs."""

import json
from pathlib import Path

UNITS = Path(__file__).parents[2] / "results" / "units"


def place_of(config: Path) -> Path:
    about = json.loads(config.read_text())
    unit = about["unit"]
    names = [unit[name] for name in ("scenario", "algorithm", "setting")]
    return UNITS.joinpath(*names, f"seed_{unit['seed']}-{about['id']}")


def test_each_unit_lies_in_its_own_directory():
    configs = sorted(UNITS.rglob("config.json"))
    assert configs
    assert [str(path) for path in configs if path.parent != place_of(path)] == []

"""Options that several commands share; options and their meanings from a config's own fields."""

import argparse
import ast
import inspect
import math
import re
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

from bridge.environments import scenarios
from bridge.network import GRAMMAR
from edge_runtime.cli import not_negative, positive_number, whole_number
from edge_runtime.util import UserError
from trainer.training.config import MOST_THREADS

Group = argparse.ArgumentParser | argparse._ArgumentGroup
DEVICES = ("cpu", "cuda")


def add_scenario(parser: Group, known: str = "") -> None:
    """Add ``--scenario``; ``known`` says in words where it comes from if not given."""
    what = f"environment: {', '.join(scenarios())}, a gymnasium id, or module:id"
    what += f" (default: {known}, else left_turn)" if known else ""
    default = None if known else "left_turn"
    parser.add_argument("--scenario", default=default, metavar="NAME", help=what)


def add_seed(parser: Group, what: str = "") -> None:
    said = f"random seed{what}"
    parser.add_argument("--seed", type=not_negative, default=0, metavar="N", help=said)


def add_threads(parser: Group) -> None:
    said = "processor threads for PyTorch; 0: its own default"
    kind = whole_number(0, MOST_THREADS)
    parser.add_argument("--threads", type=kind, default=0, metavar="N", help=said)


def add_latency(parser: Group, what: str) -> None:
    said = f"{what}: {GRAMMAR}".replace("%", "%%")
    parser.add_argument("--latency", metavar="SPEC", default="none", help=said)


def add_time_limit(parser: Group, what: str) -> None:
    text = f"{what} (default: no limit)"
    parser.add_argument("--max-minutes", type=positive_number, metavar="MIN", help=text)


def deadline_s(minutes: float | None, clock: Callable[[], float] = time.monotonic) -> float:
    """Return when the minutes are over, by ``clock``; infinity without a limit."""
    return math.inf if minutes is None else clock() + 60.0 * minutes


def add_fields(parser: Group, config: Any, *names: str) -> None:
    """Add an option for each named field of a config, which itself checks the ranges."""
    said = meanings(type(config))
    for name in names:
        option, default = f"--{name.replace('_', '-')}", getattr(config, name)
        how: dict[str, Any] = {"type": not_negative, "default": default, "metavar": "N"}
        if isinstance(default, bool):
            how = {"action": "store_true"}
        parser.add_argument(option, help=said[name].removeprefix("whether "), **how)


def meanings(config: type) -> dict[str, str]:
    """Return the first sentence of each field's docstring, by the field's name."""
    (made,) = ast.parse(textwrap.dedent(inspect.getsource(config))).body
    assert isinstance(made, ast.ClassDef)
    found = {}
    for field, text in pairwise(made.body):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            assert isinstance(field.target, ast.Name)
            docstring = " ".join(ast.literal_eval(text.value).replace("``", "").split())
            sentence = re.split(r"\. (?=[A-Z(])|\.$", docstring)[0]
            is_word = sentence[1:2].islower() or sentence[1:2] == " "
            found[field.target.id] = sentence[0].lower() + sentence[1:] if is_word else sentence
    return found


def add_device(parser: Group) -> None:
    said = "device of the neural networks"
    parser.add_argument("--device", choices=DEVICES, default=DEVICES[0], help=said)


def check_device(device: str) -> None:
    """Raise UserError unless the learner can compute there."""
    import torch  # see set_threads

    if device not in DEVICES:
        raise UserError(f"device must be one of {', '.join(DEVICES)}: {device}")
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("no CUDA device is available; use --device cpu")


def set_threads(count: int) -> None:
    """Limit PyTorch's threads; 0 leaves them alone."""
    if count:
        import torch  # takes two seconds, which --help need not wait

        torch.set_num_threads(count)


@contextmanager
def limited_threads(count: int) -> Iterator[None]:
    """Limit PyTorch's threads within a block."""
    import torch  # see set_threads

    before = torch.get_num_threads()
    set_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)

"""Trains policies with human guidance. The commands are ``python -m trainer``; in Python it is::

    from trainer import train, evaluate, export, load

    run = train("my_pkg:MyEnv-v0", algorithm="phil_td3", human="web", episodes=100)
    print(evaluate(run, runs=50).success_rate)
    export(run, "my.onnx", key="keys/policy.key")
    action = load("my.onnx").act(observation)

Nothing is imported before it is asked for: torch takes two seconds.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from trainer.evaluation import Evaluation, evaluate, load
    from trainer.policy_file import Export, export
    from trainer.training.command import Run, train

__all__ = ["Evaluation", "Export", "Run", "evaluate", "export", "load", "train"]
_PLACES = {
    **dict.fromkeys(("Run", "train"), "trainer.training.command"),
    **dict.fromkeys(("Evaluation", "evaluate", "load"), "trainer.evaluation"),
    **dict.fromkeys(("Export", "export"), "trainer.policy_file"),
}


def __getattr__(name: str) -> Any:
    if name in _PLACES:
        return getattr(import_module(_PLACES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

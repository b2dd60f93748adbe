"""The only part that runs on the board: verifies a policy, drives it over Zenoh, stops safely.

`edge_runtime.drive("my.onnx", connect="tcp/...", vehicle=MyDriver())` is `run` from Python.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from edge_runtime.run import drive

__version__ = "0.1.0"
__all__ = ["drive"]


def __getattr__(name: str) -> Any:
    if name != "drive":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from edge_runtime.run import drive  # here, so that importing the package loads no library

    return drive

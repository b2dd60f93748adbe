"""``python -m bridge sense``: the edge runtime's own `sense`, beside the simulator that it stands
in for. The board has no bridge; there it is ``python -m edge_runtime sense``.
"""

from edge_runtime import cli
from edge_runtime.sense import add_arguments, run

__all__ = ["EXAMPLE", "add_arguments", "run"]
EXAMPLE = cli.examples(
    "python -m bridge sense --source my_camera:Camera --policy my.onnx --vehicle-id hunter01"
)

"""The T-intersection as a highway-env road network, and as paved ground for the rasteriser."""

from __future__ import annotations

import math

from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import LaneIndex, RoadNetwork

from trainer.scenarios.geometry import Rectangle
from trainer.scenarios.path import LeftTurnPath

LANE_REACH_M = 100.0
"""How far the main road goes on to either side."""
SIDE_ROAD_M = 40.0
NEAR_LANE: LaneIndex = ("west", "east", 0)
"""The lane of the main road that the ego car must cross; the other one it joins."""


def t_intersection(path: LeftTurnPath, goal_m: float, lane_width_m: float) -> RoadNetwork:
    """Both lanes of the main road (y = 0 between them), and the ego car's path as lanes."""
    network, half, reach = RoadNetwork(), 0.5 * lane_width_m, LANE_REACH_M
    lines = (LineType.STRIPED, LineType.CONTINUOUS)
    for start, end, y in (("west", "east", half), ("east", "west", -half)):
        direction = 1.0 if start == "west" else -1.0
        lane = StraightLane(
            (-direction * reach, y),
            (direction * reach, y),
            lane_width_m,
            line_types=lines,
            # The cars' own desired speeds are what limits them.
            speed_limit=None,
        )
        network.add_lane(start, end, lane)
    nodes = ("south", "turn", "exit", "goal")
    lanes = path.lanes(goal_m, lane_width_m)
    for start, end, lane in zip(nodes[:-1], nodes[1:], lanes, strict=True):
        network.add_lane(start, end, lane)
    return network


def road_areas(lane_width_m: float) -> list[Rectangle]:
    """The paved ground: the main road across, the side road from below."""
    width_m = 2 * lane_width_m
    side_road = Rectangle(0.0, 0.5 * SIDE_ROAD_M, 0.5 * math.pi, SIDE_ROAD_M, width_m)
    return [Rectangle(0.0, 0.0, 0.0, 2 * LANE_REACH_M, width_m), side_road]

"""The jam around the ego car: three lanes, and who drives where in them at the start."""

from __future__ import annotations

import itertools

import numpy as np
from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import LaneIndex, Road, RoadNetwork

from trainer.scenarios.congestion_config import CongestionConfig
from trainer.scenarios.ego import EgoVehicle
from trainer.scenarios.traffic import TrafficVehicle, queue
from trainer.scenarios.vehicle_types import bodies_m, draw_types, equip

LANES = 3
EGO_LANE = 1
"""The middle one, y = 0; lane 0 is to its left."""
REACH_M = 200.0
"""How far the road goes on before start and goal."""


def straight_road(lane_width_m: float, goal_m: float) -> RoadNetwork:
    """Three lanes in the direction of x."""
    network = RoadNetwork()
    for lane in range(LANES):
        y = (lane - EGO_LANE) * lane_width_m
        ends = (-REACH_M, y), (goal_m + REACH_M, y)
        lines = (LineType.CONTINUOUS if lane == 0 else LineType.NONE, LineType.CONTINUOUS)
        # No speed limit: the cars' own desired speeds are what limits them.
        road = StraightLane(*ends, lane_width_m, line_types=lines, speed_limit=None)
        network.add_lane("start", "end", road)
    return network


def spawn_jam(
    road: Road, ego: EgoVehicle, config: CongestionConfig, random: np.random.Generator
) -> list[TrafficVehicle]:
    """Surround the ego car: cars ahead of it, beside it, and in the variant behind it."""
    jam_mps = float(random.uniform(*config.jam_speed_mps))
    cars: list[TrafficVehicle] = []
    for lane in range(LANES):
        first_mps = jam_mps + float(random.uniform(*config.lane_speed_mps))
        if lane == EGO_LANE:
            own = _own_lane(road, ego, config, random)
        else:
            own = _side_lane(road, lane, config, random)
        # The first of a lane goes with the jam, the others would go faster if they could.
        own[0].speed = own[0].target_speed = first_mps
        cars += own
    for car in cars:
        car.position[1] += float(random.uniform(*config.lane_offset_m))
    return cars


def _side_lane(
    road: Road, lane: int, config: CongestionConfig, random: np.random.Generator
) -> list[TrafficVehicle]:
    types = draw_types(config.traffic_mix, config.side_cars, random)
    x = [float(random.uniform(*config.side_front_m))]
    for ahead, behind in itertools.pairwise(types):
        x.append(x[-1] - bodies_m(behind, ahead) - float(random.uniform(*config.gap_m)))
    cars = _queue(road, lane, x, config, random)
    equip(cars, types, config.time_gap_factor)
    return cars


def _own_lane(
    road: Road, ego: EgoVehicle, config: CongestionConfig, random: np.random.Generator
) -> list[TrafficVehicle]:
    """One car ahead of the ego car; those behind follow the ego car as one of theirs."""
    types = draw_types(config.traffic_mix, 1 + config.cars_behind, random)
    nose_m = 0.5 * ego.LENGTH
    x = [nose_m + float(random.uniform(*config.ahead_gap_m)) + 0.5 * types[0].length_m]
    tail_m = -nose_m
    for kind in types[1:]:
        x.append(tail_m - float(random.uniform(*config.gap_m)) - 0.5 * kind.length_m)
        tail_m = x[-1] - 0.5 * kind.length_m
    cars = _queue(road, EGO_LANE, x, config, random)
    if config.cars_behind:
        cars[1].leader = ego
    equip(cars, types, config.time_gap_factor)
    return cars


def _queue(
    road: Road, lane: int, x: list[float], config: CongestionConfig, random: np.random.Generator
) -> list[TrafficVehicle]:
    index: LaneIndex = ("start", "end", lane)
    speeds = [float(v) for v in random.uniform(*config.traffic_speed_mps, size=len(x))]
    cars = queue(road, index, [REACH_M + place for place in x], speeds)
    for car in cars:
        car.target_speed = config.desired_speed_mps
    return cars

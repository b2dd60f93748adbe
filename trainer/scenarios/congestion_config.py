"""Every number of the congestion scenario."""

from __future__ import annotations

from dataclasses import dataclass, replace

from trainer.scenarios.environment import Range, Scene
from trainer.scenarios.vehicle_types import CARS_ONLY, MIXED, Mix


@dataclass(frozen=True)
class CongestionConfig:
    """One field a number, with its reason."""

    control_period_s: float = 0.1
    """Control interval of all vehicles (section VI-A)."""
    max_steps: int = 300
    """Steps until the episode is cut off as a timeout; at 4 m/s the goal takes 200."""
    lane_width_m: float = 3.5
    goal_m: float = 80.0
    """Distance along the road from start to goal."""
    lambda_rad: float = 0.15
    """Front-wheel angle at full action: eq. 29's 5 lambda pi. With 5 pi rad of steering wheel for
    the front wheels' 45 degrees, lambda is 0.19. At 5 m/s the heading then changes by at most
    0.015 rad a step: enough to save a car 2 s before it touches its neighbour."""
    start_offset_m: Range = (-0.3, 0.3)
    """The ego car's place in its lane at the start."""
    start_heading_rad: Range = (-0.05, 0.05)
    """Its heading: at the edges of this range the wheels held straight lead 4 m aside."""
    ego_speed_mps: Range = (4.0, 6.0)
    """Initial speed of the ego car."""
    desired_speed_mps: float = 6.0
    """Target of the IDM on the ego car's pedals (section VI-A), and of the cars behind others."""
    brake_mps2: float = 4.0
    """Deceleration of the ego car at most; what the brake of a safe stop does."""
    traffic_speed_mps: Range = (4.0, 6.0)
    """Initial speeds of traffic (section VI-A)."""
    jam_speed_mps: Range = (4.5, 5.5)
    """Speed of the whole jam, and ..."""
    lane_speed_mps: Range = (-0.5, 0.5)
    """... what each lane's first car is faster. Lanes that drifted apart at 2 m/s would leave the
    ego car alone before half of the way."""
    side_cars: int = 3
    """In each neighbouring lane; with those ahead and behind these are the eight within 20 m."""
    cars_behind: int = 1
    """In the ego car's lane. They follow it as one of them: traffic keeps lanes, so a car
    elsewhere has nothing to react to."""
    traffic_mix: Mix = CARS_ONLY
    side_front_m: Range = (9.0, 13.0)
    """How far each neighbouring lane's first car is ahead, centre to centre (of cars)."""
    gap_m: Range = (3.5, 5.5)
    """Between bumpers in a lane, at the start."""
    ahead_gap_m: Range = (4.0, 9.0)
    """From the ego car to the one ahead of it."""
    time_gap_factor: float = 0.5
    """Share of a vehicle's usual time gap that is kept in the jam."""
    lane_offset_m: Range = (-0.2, 0.2)
    """Where in its lane each car drives; the narrowest gap then leaves 1.3 m to each side of an
    ego car in mid-lane, in the variant 1.1 m."""
    goal_reward: float = 10.0
    fail_reward: float = -10.0
    steer_weight: float = 0.1
    """Scale of the steering term: this times the change of the action, which costs (eq. 32 is
    printed without the minus sign that its text demands). With gamma 0.95 and 10 Hz the horizon is
    2 s. A correction (the action out, across and back, 2 in all) costs 0.2; the crash that it
    avoids is worth -3.6 seen 20 steps ahead and -0.8 seen 50 ahead, so correcting early pays. With
    weight 1 it would pay to wait for the last second; worse, trembling at random (2/3 a step) would
    cost 13 in discounted sum, and an early crash, which is -10, would be the best policy of a
    beginner. With 0.1 trembling costs 1.3: felt, and never worth a crash."""
    metres_per_pixel: float = 0.375
    view_behind_m: float = 12.0
    """The picture shows 30 m x 16.9 m of ground, all three lanes. It moves along the road with the
    ego car, and neither turns nor moves aside: place and heading show as they are, and other cars'
    movement between the two frames is their speed relative to the ego car's."""

    def with_printed_reward(self) -> CongestionConfig:
        """The same with eq. 32 as it is printed, but for the sign."""
        return replace(self, steer_weight=1.0)

    @staticmethod
    def of(scene: Scene) -> CongestionConfig:
        """The numbers of a scene.

        The variant has more vehicles, and not only cars. Dense is a jam in lanes as narrow as at
        roadworks, in which cars keep to their lane's middle, and lanes to the jam's speed, about
        half as well as usual. The narrowest gap leaves 0.5 m to each side of an ego car in mid-lane
        instead of 1.25, and its walls move; were it narrower, cars of two lanes would touch. Gaps
        along a lane are from 2 to 8 m, so that the walls have holes, too; a lane's queue is long
        enough to be there until the goal.
        """
        if scene == "nominal":
            return CongestionConfig()
        if scene == "variant":
            return CongestionConfig(side_cars=4, cars_behind=2, traffic_mix=MIXED)
        return CongestionConfig(
            lane_width_m=2.9,
            lane_offset_m=(-0.35, 0.35),
            lane_speed_mps=(-1.0, 1.0),
            side_cars=6,
            side_front_m=(14.0, 22.0),
            cars_behind=2,
            gap_m=(2.0, 8.0),
            ahead_gap_m=(2.5, 9.0),
        )

"""The human in the left turn: foresight, the scripted expert, and when a person would take over.

All three know the true state. Section V leaves these activation conditions open.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trainer.human.guide import Expert, Reason
from trainer.scenarios.base import EgoVehicle, Observation
from trainer.scenarios.left_turn import LeftTurnEnv
from trainer.scenarios.picture import Rectangle, corners

TABLE_STEP_M = 0.1
SIDE_CLEARANCE_M = 0.3  # Room to the sides of a passing car


@dataclass(frozen=True)
class PedalPlan:
    """A plan for the ego car: a pedal for a while, then a speed."""

    pedal: float = 1.0
    hold_s: float = 0.0
    then_mps: float = 0.0  # Full throttle up to this speed; a faster car keeps its own
    then_brake: float = 0.0  # Instead of that: this share of the full brake, until the car stands


class Crossing:
    """Predicts conflicts in a left turn."""

    def __init__(self, env: LeftTurnEnv) -> None:
        self.env = env
        config = env.config
        lane_y, half_width_m = 0.5 * config.lane_width_m, 0.5 * EgoVehicle.WIDTH + SIDE_CLEARANCE_M
        stretch = [
            _stretch_in_strip(self._footprint(s_m), lane_y - half_width_m, lane_y + half_width_m)
            for s_m in np.arange(0.0, config.goal_m + 10.0, TABLE_STEP_M)
        ]
        self._covered_x = np.array(stretch)

    def clear(self, horizon_s: float, margin_m: float, plan: PedalPlan) -> bool:
        """Whether no car comes within ``margin_m`` along the lane during ``horizon_s``."""
        s_m, _ = self._ego_motion(horizon_s, plan)
        time_s = np.linspace(0.0, (len(s_m) - 1) * self.env.config.control_period_s, len(s_m))
        cells = np.minimum((s_m / TABLE_STEP_M).astype(int), len(self._covered_x) - 1)
        rear_x, front_x = self._covered_x[cells].T
        # All cars at once; the reshape also works without cars.
        cars = [(car.position[0], car.speed, car.LENGTH) for car in self.env.traffic]
        x, speed_mps, length_m = np.array(cars).reshape(-1, 3).T[:, :, None]
        car_x, reach_m = x + speed_mps * time_s, 0.5 * length_m + margin_m
        return not np.any((car_x + reach_m > rear_x) & (car_x - reach_m < front_x))

    def state_after(self, horizon_s: float, plan: PedalPlan) -> tuple[float, float]:
        """Return the path length (m) and the speed (m/s) after ``horizon_s``."""
        s_m, speed_mps = self._ego_motion(horizon_s, plan)
        return float(s_m[-1]), speed_mps

    def in_lane(self, s_m: float) -> bool:
        """Whether the ego car at this path length reaches into the traffic's way."""
        cell = min(int(s_m / TABLE_STEP_M), len(self._covered_x) - 1)
        return bool(np.isfinite(self._covered_x[cell, 0]))

    def _ego_motion(self, horizon_s: float, plan: PedalPlan) -> tuple[NDArray[np.float64], float]:
        """Return the arc lengths reached (m), from now on at every step, and the last speed."""
        c, dt_s = self.env.config, self.env.config.control_period_s
        steps, held = round(horizon_s / dt_s), round(plan.hold_s / dt_s)
        held_mps2 = plan.pedal * (c.throttle_mps2 if plan.pedal > 0 else c.brake_mps2)
        speed_mps, s_m = self.env.ego.speed, self.env.distance_m
        positions = [s_m]
        for step in range(steps):
            # As the car itself: the position uses the speed at the start of the step.
            s_m += speed_mps * dt_s
            if step < held:
                speed_mps = min(max(speed_mps + held_mps2 * dt_s, 0.0), c.max_speed_mps)
            elif plan.then_brake:
                speed_mps = max(speed_mps - plan.then_brake * c.brake_mps2 * dt_s, 0.0)
            elif speed_mps < plan.then_mps:
                speed_mps = min(speed_mps + c.throttle_mps2 * dt_s, plan.then_mps)
            positions.append(s_m)
        return np.array(positions), speed_mps

    def _footprint(self, s_m: float) -> Rectangle:
        pose = self.env.path.pose(s_m)
        length_m, width_m = EgoVehicle.LENGTH, EgoVehicle.WIDTH
        # In the bend the tracked car points inwards by the slip angle.
        slip_rad = math.asin(0.5 * length_m * self.env.path.curvature(s_m))
        return Rectangle(pose.x, pose.y, pose.heading - slip_rad, length_m, width_m)


def _stretch_in_strip(shape: Rectangle, low_y: float, high_y: float) -> tuple[float, float]:
    """Return the x range that a rectangle covers between two y values; (inf, -inf): none."""
    points = corners(shape)
    xs: list[float] = []
    for (x0, y0), (x1, y1) in zip(points, np.roll(points, -1, axis=0), strict=True):
        if low_y <= y0 <= high_y:
            xs.append(x0)
        for level in (low_y, high_y):
            if (y0 - level) * (y1 - level) < 0:
                xs.append(x0 + (x1 - x0) * (level - y0) / (y1 - y0))
    return (min(xs), max(xs)) if xs else (math.inf, -math.inf)


class LeftTurnHuman(Expert):
    """Waits at the stop line, picks a gap, then commits to it; also judges the policy's action.

    A car that stops with its nose in the lane is hit. So starting needs a wide gap, and going on
    only a narrow one, which is safe and easier to imitate.

    As a judge it accepts what leaves a way out and does not stop in the lane. To follow the present
    pedal alone would be to object to each brisk approach, the expert's own included; but theorem 1
    holds only where no optimal policy is taken over from.
    """

    HORIZON_S = 6.0
    START_MARGIN_M = 2.5
    """Room to every car while turning. With 1.5 m the expert is as safe, but its imitators start
    some tenths of a second early or late, and one in ten touches the car that just passed."""
    KEEP_MARGIN_M = 0.3
    POINT_OF_NO_RETURN_M = 8.0
    """Path length at which the nose comes within 0.5 m of the cars of the near lane."""
    APPROACH_MPS2 = 1.5
    """Comfortable deceleration towards the stop line; full brake is kept for surprises."""
    CRUISE_MPS = 5.2
    GO = PedalPlan(then_mps=CRUISE_MPS)

    HOLD_S = 0.5  # Time for which the judged pedal is held: a person's reaction time
    RESCUE_BRAKE = 0.85
    """Share of the full brake that must still stop the car in time after ``HOLD_S``; the rest is a
    reserve for a human model."""
    STOP_BY_M = POINT_OF_NO_RETURN_M - 0.5
    """Path length by which the car must then stand: a car that creeps up to the point of no return,
    past which it can only drive on, is not waiting."""
    RESCUE_MARGIN_M = 1.0
    """Distance to cars along the lane that driving on at full throttle must then keep."""
    HESITATION_S = 1.0
    """Time for which the judged pedal is predicted, to see whether the car stops in the lane."""
    CRAWL_MPS = 1.5
    """A car predicted to be slower than this in the lane counts as stopping there: a fault, since
    the traffic does not yield."""
    STANDING_MPS = 0.3
    STANDING_STEPS = 15  # Steps after which a standing car counts as waiting
    OPEN_STEPS = 5
    """Steps for which a waiting car's way must be free before it is stuck: a reaction time."""
    START_PEDAL = 0.2  # Least throttle that counts as starting by itself

    def __init__(self, env: LeftTurnEnv) -> None:
        self.env = env
        self.crossing = Crossing(env)
        self.reset()

    def reset(self) -> None:
        self.going = False
        self.standing_steps = self.open_steps = 0

    def act(self, observation: Observation | None = None) -> NDArray[np.float32]:
        """Return the expert's pedal, float32 [1], from the true state, not the picture."""
        stopping_m = self.env.ego.speed**2 / (2.0 * self.env.config.brake_mps2)
        if self.env.distance_m + stopping_m > self.POINT_OF_NO_RETURN_M:
            self.going = True  # Even full brake would leave the nose in the lane.
        else:
            margin_m = self.KEEP_MARGIN_M if self.going else self.START_MARGIN_M
            self.going = self.crossing.clear(self.HORIZON_S, margin_m, self.GO)
        go = min(max(2.0 * (self.CRUISE_MPS - self.env.ego.speed), -1.0), 1.0)
        return np.array([go if self.going else self._wait()], dtype=np.float32)

    def _wait(self) -> float:
        """Slow down with the distance to the line, and stand there."""
        to_line_m = self.env.config.stop_line_m - self.env.distance_m
        wanted_mps = math.sqrt(2.0 * self.APPROACH_MPS2 * max(to_line_m - 0.5, 0.0))
        if wanted_mps == 0.0:
            return -1.0
        return min(max(wanted_mps - self.env.ego.speed, -1.0), 0.3)

    def wants_control(self, action: NDArray) -> Reason | None:
        """Return why a person would take over from ``action`` now, or None; call it once a step."""
        pedal = float(action[0])
        standing = self.env.ego.speed < self.STANDING_MPS
        self.standing_steps = self.standing_steps + 1 if standing else 0
        waiting = self.standing_steps > self.STANDING_STEPS
        is_open = waiting and self.crossing.clear(self.HORIZON_S, self.START_MARGIN_M, self.GO)
        self.open_steps = self.open_steps + 1 if is_open else 0
        if not self._leaves_a_way_out(pedal):
            return "collision"
        if self._stops_in_the_lane(pedal):
            return "lane"
        return "stuck" if self.open_steps > self.OPEN_STEPS and pedal < self.START_PEDAL else None

    def may_return(self) -> bool:
        """Whether control can be handed back: not while driving through the lane.

        A human who stands in it hands back, as a human model might stand there for ever.
        """
        standing = self.env.ego.speed < self.STANDING_MPS
        return standing or not self.crossing.in_lane(self.env.distance_m)

    def _stops_in_the_lane(self, pedal: float) -> bool:
        """Whether after this pedal the car hardly moves, with its nose in the lane."""
        if pedal >= self.START_PEDAL:
            return False
        held = PedalPlan(pedal, self.HESITATION_S)
        at_m, speed_mps = self.crossing.state_after(self.HESITATION_S, held)
        return speed_mps < self.CRAWL_MPS and self.crossing.in_lane(at_m)

    def _leaves_a_way_out(self, pedal: float) -> bool:
        """Whether after this pedal the car can still be stopped, or driven on, unharmed."""
        crossing = self.crossing
        stop = PedalPlan(pedal, self.HOLD_S, then_brake=self.RESCUE_BRAKE)
        before_m = self.POINT_OF_NO_RETURN_M - self.env.distance_m
        if pedal <= 0.0 and self.env.ego.speed == 0.0 and before_m >= 0.0:  # It goes on standing.
            return True
        if crossing.state_after(self.HORIZON_S, stop)[0] <= self.STOP_BY_M:
            return True
        go = PedalPlan(pedal, self.HOLD_S, then_mps=self.CRUISE_MPS)
        return crossing.clear(self.HORIZON_S, self.RESCUE_MARGIN_M, go)


class SlowHuman(LeftTurnHuman):
    """A human who drives slower than the reward's target speed.

    All of its drives reach the goal, too (40 of 40), after 10.4 s instead of 7.9 s, with a return
    of 3.8 instead of 6.2.
    """

    CRUISE_MPS = 3.0
    GO = PedalPlan(then_mps=CRUISE_MPS)

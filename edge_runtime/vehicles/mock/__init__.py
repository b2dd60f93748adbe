"""A vehicle of arithmetic, for the bench without a chassis."""

from edge_runtime.vehicles.mock.vehicle import MockParameters, MockState, MockVehicle, advance

__all__ = ["MockParameters", "MockState", "MockVehicle", "advance"]

"""What a vehicle costs: policy in the loop against vehicle in the loop, and the lag it may have."""

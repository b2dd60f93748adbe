"""How much network a policy bears, and how the loop takes every fault: one report."""

"""What bridge and trainer show in rerun alike: where it goes, the road from above, the plots."""

"""What stands beside the rig: the daemon, and recording without tracking."""

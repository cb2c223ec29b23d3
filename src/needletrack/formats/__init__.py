"""Other tools' calibration files, read as a rig and written from one."""

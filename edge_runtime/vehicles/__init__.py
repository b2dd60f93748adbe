"""Vehicle drivers: the interface, one file for each vehicle, and the thread that runs one."""

"""Vehicle drivers: the interface, one folder for each vehicle, and the thread that runs one."""

"""What ``trainer train --rerun`` is made of: a watcher of the loop, and its picture in rerun."""

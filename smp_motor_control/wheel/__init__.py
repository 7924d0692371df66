"""One wheel: its speed loop and what keeps it safe, without ROS."""

"""The body on its wheels: kinematics, limits and odometry."""

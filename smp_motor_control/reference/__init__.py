"""References of a speed: within limits, smooth, and as fast as the voltage allows."""

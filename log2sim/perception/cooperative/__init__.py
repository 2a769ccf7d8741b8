"""What the sensors of the vehicle and of the road see together: boxes of both ends become one."""

"""What runs on the drone: LiDAR, odometry, estimator, policy, safety, failsafe, autopilot link, runner."""

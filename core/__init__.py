"""The vocabulary every part shares: frames, LiDAR, evidence map, observation, policy contract, config."""

"""The pymunk twin: levels, physics, rays, radio medium, batched exploration, vehicles in the loop."""

"""Watch a policy: viewer, videos and film strips, drawn by C MuJoCo from trajectories of the simulator."""

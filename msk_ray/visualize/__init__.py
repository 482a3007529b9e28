"""Pictures of a policy: videos and film strips, drawn by C MuJoCo from trajectories of the simulator."""

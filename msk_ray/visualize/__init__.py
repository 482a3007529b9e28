"""What does a policy do? Viewer, videos and film strips, drawn by C MuJoCo from trajectories of the simulator."""

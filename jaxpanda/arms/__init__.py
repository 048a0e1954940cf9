"""What an arm is, what it is read from and what it is written to: MJCF, URDF, and the project's own Panda."""

"""What is simulated: the rig, its motion, room and noise."""

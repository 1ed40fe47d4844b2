"""Description of a simulation: the rig, its motion, the room and the noise."""

"""Messages of bags: point clouds, poses, wheels."""

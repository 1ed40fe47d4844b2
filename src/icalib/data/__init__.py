"""Sensor data: streams of measurements, and readers of recordings (bags, folders of tables, images, videos)."""

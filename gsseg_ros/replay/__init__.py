"""Replays a dataset or a bag as the topics of a robot."""

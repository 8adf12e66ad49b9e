"""A run as a folder: checkpoints to go on from, one lock, logs. Knows of the agents only
``TrainConfig``.
"""

"""Agents on their way to others: the files of a folder on the hub, written from a run."""

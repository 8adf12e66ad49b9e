"""Benchmarks in which every frame is consumed."""

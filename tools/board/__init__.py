"""The leaderboard: a protocol, entries in one file each, their checks, and the page."""

"""Record episodes of random, scripted and trained players as GIF or MP4."""

"""What the memory did: measures over runs and agents, arrays out."""

"""Play by hand: the session is a state machine of its own, a window and a terminal show it."""

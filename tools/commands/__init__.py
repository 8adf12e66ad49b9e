"""Commands of arcade-torch; every one is a dataclass whose fields are its options."""

"""Commands of arcade-torch, one module each; every one is a dataclass whose fields are its options."""

"""The paper's figures from run folders, each with its numbers beside it."""

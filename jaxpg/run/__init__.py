"""The training loop and its terminal."""

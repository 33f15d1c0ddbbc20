"""What the stages cost here: `segfloor benchmark`, on generated data."""

"""The segfloor command."""

"""What developers measure with; the package does not need it."""

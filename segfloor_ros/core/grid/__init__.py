"""The occupancy grid: obstacle layer, free layer, map files."""

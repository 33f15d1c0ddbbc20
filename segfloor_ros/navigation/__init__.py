"""Where to drive on a map that grows: map, points of obstacles and the free scan in, speeds out.

A small stand-in for Nav2 that needs no ROS: a costmap with inflated obstacles, the shortest path on
it (Dijkstra), frontiers (Yamauchi, 1997) and pure pursuit (Coulter, 1992).
"""

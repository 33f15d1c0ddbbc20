"""What the five nodes share: states, parameters, subscriptions and joins, reports, tf, kept maps.

In: topics, parameters. Out: callbacks with joined messages, diagnostics, what survives a crash.
The way in is `stage_node.StageNode`.
"""

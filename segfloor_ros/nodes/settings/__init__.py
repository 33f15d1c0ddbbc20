"""The parameters of each node: the settings of its stage, and what only nodes have: frames, rates,
quality of service. A node loads its own; `nodes.configuration` collects them.
"""

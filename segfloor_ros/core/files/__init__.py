"""Files that are read whole, one reader per kind: bytes, text, JSON, tables, images, saved maps.

In: a path that anybody may have named, with anything in it. Out: plain values, or one error that
names the file. No reader waits for a FIFO, takes more memory than a file of its kind may need, or
lets a library write to standard error. YAML is read by `nodes.yaml_files`.
"""

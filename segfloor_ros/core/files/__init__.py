"""Files that are read whole, one reader per kind: bytes, text and JSON, YAML, tables of numbers,
images, saved maps. What comes in is a path that anybody may have named, with anything in it; what
goes out is plain values, or one error that names the file. No reader waits for a FIFO, takes more
memory than a file of its kind may need, or lets a library write to standard error. Results are
written by `results` alone.
"""

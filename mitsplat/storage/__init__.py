"""Files, the cache, content hashes, and validated YAML and JSON input.

In: paths and values. Out: files that appear complete or not at all, and errors of one sentence that name the file and
the key.
"""

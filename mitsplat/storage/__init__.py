"""Files, the cache, content hashes, and validated YAML and JSON input.

Input: paths and values. Output: files that appear complete or not at all, and errors of one sentence that name the file
and the key.
"""

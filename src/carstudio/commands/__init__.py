"""The verbs of the command line: one module each, a dataclass whose fields are the options and whose run() works."""

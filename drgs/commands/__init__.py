"""What `drgs` on the command line does: a module a command, with its options in options.py.

A new command is a dataclass in options.py, a module here whose `run(args)` returns None or an exit code, and its name
in cli.py. What it is given to look at is `SceneInput` (scene_input.py); viewpoints.py says which views an option names.
"""

"""Files that survive a crash: written whole or not at all, by one process at a time, with a record of what is done.

outputs      what a command may write, and writing it: never over an input, never over a file that is not ours
journal      what is done, line by line: the log of a run, the rows of a study, what drgs wrote into a folder
checkpoint   tensors and a header, of a fit or a planner
run          the folder of a run
locks        one writer a folder
atomic       hidden files that become whole ones, and errors of writing
interrupts   Ctrl-C, SIGTERM and SIGHUP
json_files   JSON and TOML that others wrote
foreign      files of another kind than their reader expects
"""

"""Files that survive a crash: written whole or not at all, by one process at a time, with a record of what is done.

journal     what is done, line by line: the log of a run, the rows of a study, what drgs wrote into a folder
"""

"""Choosing among views: the pool, the greedy choice, its cache, and the policies that `drgs.select` names.

informed.py   the information of views: `fisher`, `fisherrf`, `coverage`
pictures.py   what candidates show, each by itself: `moments`, `blur`, `renderers`
spread.py     poses only, or nothing: `farthest`, `uniform`, `random`
"""

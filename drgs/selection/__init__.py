"""Choosing among views.

pool.py       the views to choose from, and what is computed of them; the choice
greedy.py     one view at a time, each against what is known once those before it are; combine.py, refining.py
cache.py      quantities of views, kept from call to call; drift.py
policies.py   how a policy is looked up and called

Policies, functions from a `Pool` to a `Selection`, by what they go by:

informed.py   the information of views: `fisher`, `fisherrf`, `coverage`
pictures.py   renderings of candidates, each by itself: `moments`, `blur`, `renderers`
spread.py     poses only, or nothing: `farthest`, `uniform`, `random`
"""

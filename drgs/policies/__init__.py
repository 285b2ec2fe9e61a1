"""Policies: functions from a `Pool` to a `Selection`, by what they look at; `drgs.select` names them.

informed.py   the information of views: `fisher`, `fisherrf`, `coverage`; `moments` of what they show
spread.py     poses only, or nothing: `farthest`, `uniform`, `random`
"""

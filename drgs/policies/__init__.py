"""Policies: functions from a `Pool` to a `Selection`, by what they look at; `drgs.select` names them.

informed.py   the information of views: `fisher`, `fisherrf`, `coverage`
pictures.py   what candidates show, each by itself: `moments`, `blur`, `renderers`
spread.py     poses only, or nothing: `farthest`, `uniform`, `random`
"""

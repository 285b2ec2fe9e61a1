"""Policies: functions from a `Pool` to a `Selection`, by what they look at; `drgs.select` names them.

informed.py   the information of views: `fisher`, `fisherrf`, `coverage`; `moments` of what they show
spread.py     poses only, or nothing: `poses`, `farthest`, `uniform`, `random`
facility.py   places that views will show (places.py), whatever the model has there; field.py, the same as errors
mixed.py      poses and information: `switch`, `diverse`
"""

"""A viewer in the browser, by viser: the client draws Gaussians, and our own image comes where its camera rests.

gate        who may talk to it: addresses, tokens, origins
wire        its socket, and what is answered on it
server      starts viser behind the gate, and gives every browser a session
session     one browser: what it shows, where its camera rests, what it is sent
panel       what stands in the browser's panel, as escaped HTML
subject     what is looked at
layers      which pictures of it there are
drawing     a picture in steps, a small one first
uncertainty what the photographs leave uncertain, found on the way
worker      the one thread that computes
splats      Gaussians as the client takes them
placed_views where photographs were taken, or could be
poses       the client's cameras and ours
"""

from drgs.guards.imports import modules_of

__getattr__ = modules_of(__name__)

"""From a phone's photographs or videos to a run: steps that can be resumed, a plan for a budget of time, and advice."""

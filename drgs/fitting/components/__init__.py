"""What a fit has besides photographs and Gaussians: one file each, all kept by the protocol of `base.py`."""

__all__: list[str] = []

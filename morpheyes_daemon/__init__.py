"""The onboard daemon of a quadrotor whose stereo baseline changes in flight."""

__version__ = "0.1.0"

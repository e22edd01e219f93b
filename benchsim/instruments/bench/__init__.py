"""The rotating-mirror bench: what joins traces, ray model and vector model."""

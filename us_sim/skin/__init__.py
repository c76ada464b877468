"""The patient's skin: a surface, and a membrane that the probe deforms."""

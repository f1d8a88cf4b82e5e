"""Instruments that show what an encoder has learned."""

"""Retrieval: arrays in, decisions out."""

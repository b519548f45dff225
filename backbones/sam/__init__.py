"""Segment Anything: its proposals, and what is made of them."""

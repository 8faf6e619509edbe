"""Checks of recorded pushes that need no model of the object: contact, clocks and measured forces agree with each other or do not.

They belong to the records: imports, readers, identification, diagnosis and nodes all repeat what they find (`records.py`).
"""

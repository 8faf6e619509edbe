"""The fault suite: live nodes in processes of their own, faults injected from outside, oracles checked after each of them."""

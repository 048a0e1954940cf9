"""Which effects a model lacks: what is proposed, steps to likelier models, and what recordings would show."""

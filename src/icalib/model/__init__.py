"""How a kind of sensor enters the problem: the base class of every `sensors/KIND/model.py`."""

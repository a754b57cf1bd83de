# protobuf makes the classes of a message when it is imported.
from typing import Any

def __getattr__(name: str) -> Any: ...

"""Client of the service: submit captures, follow their training, fetch views and results.

`Client` blocks, `AsyncClient` awaits; both have the same methods. Neither needs the rest of GrainGS: copy this folder,
and install httpx2, to use it elsewhere.
"""

from client.answers import ClientError, Event, RefusedError, RemoteJob
from client.asynchronous import AsyncClient
from client.blocking import Client

__all__ = ["AsyncClient", "Client", "ClientError", "Event", "RefusedError", "RemoteJob"]

"""Settings of the service. Every field can be set by an environment variable `GRAINGS_<FIELD>`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from ipaddress import ip_address
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from graings.errors import ConfigError
from graings.kernel.threads import usable_cores
from jobs.commands import default_database

PREFIX = "GRAINGS_"


class Settings(BaseModel):
    """Settings of one API process."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    data: Path = Field(Path("data"), description="Folder with captures and jobs.")
    database: str | None = Field(None, description="sqlite:///… or postgresql://…; null: SQLite in the data folder.")
    host: str = Field("127.0.0.1", description="Address to listen on. One that other machines can reach needs a key.")
    allowed_hosts: str = Field(
        "localhost",
        description="Host names of the service, besides IP addresses, separated by commas; * for any. Others are "
        "refused: a page of another site can resolve its own name to this machine.",
    )
    port: int = Field(8000, ge=0, le=65535, description="Port to listen on.")
    max_upload_mb: int = Field(4_096, ge=1, description="Largest accepted archive, in MB.")
    max_unpacked_mb: int = Field(16_384, ge=1, description="Largest capture after unpacking, in MB.")
    max_files: int = Field(20_000, ge=1, description="Greatest number of files in an archive.")
    min_free_mb: int = Field(512, ge=0, description="Free disk space, in MB, below which the service is not ready.")
    models_mb: int = Field(256, ge=1, description="Memory for models, in MB; at least one is kept.")
    images_mb: int = Field(32, ge=0, description="Memory for the last rendered images, in MB.")
    render_slots: int | None = Field(
        None, ge=1, le=256, description="Images rendered at the same time; null: as many as there are cores."
    )
    render_waiting: int = Field(
        16, ge=0, le=1_000, description="Requests for images that may wait; further ones get 503."
    )
    render_threads: int = Field(1, ge=1, le=256, description="CPU threads per image.")
    key_requests: int = Field(3_000, ge=1, description="Requests that a key may send in a minute.")
    key_open_requests: int = Field(64, ge=1, description="Requests of a key at a time, without event streams.")
    key_open_streams: int = Field(64, ge=1, description="Event streams of a key at a time: pages on a running job.")

    @property
    def database_url(self) -> str:
        """The URL of the database, which is in the data folder by default."""
        return self.database or default_database(self.data)

    @property
    def is_local(self) -> bool:
        """Whether no other machine can reach `host`."""
        if self.host.lower() == "localhost":
            return True
        try:
            return ip_address(self.host).is_loopback
        except ValueError:  # a name, which may be of any address
            return False

    @property
    def images_at_once(self) -> int:
        """How many images are rendered at the same time."""
        return self.render_slots or usable_cores()

    @property
    def allowed_host_names(self) -> frozenset[str]:
        """The names in `allowed_hosts`, in lower case."""
        return frozenset(name.strip().lower() for name in self.allowed_hosts.split(","))

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ, **given: object) -> Settings:
        """Settings from the environment, overridden by those in `given` that are not None. Raises `ConfigError`."""
        values: dict[str, object] = {
            name: environment[PREFIX + name.upper()]
            for name in cls.model_fields
            if PREFIX + name.upper() in environment
        }
        values |= {name: value for name, value in given.items() if value is not None}
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            problems = "; ".join(f"{PREFIX}{str(e['loc'][0]).upper()}: {e['msg']}" for e in error.errors())
            raise ConfigError(f"{problems}. docs/api.md lists every setting.") from error

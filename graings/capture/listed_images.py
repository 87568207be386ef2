"""ListedImages: the images that one file of a capture lists, of which a few may not be on disk."""

from __future__ import annotations

from typing import Final

from graings.capture.folder import CaptureFolder
from graings.capture.image_file import ImageFile
from graings.capture.mask import check_mask
from graings.errors import CaptureError

# Above this share of missing images the list or the folder is wrong, rather than some pictures thrown away.
MAX_MISSING: Final = 0.2

NAMED: Final = 3  # so many names are given in a note


class ListedImages:
    """Finds the images that `source` lists and counts those that are missing."""

    def __init__(self, folder: CaptureFolder, source: str) -> None:
        self.folder, self.source = folder, source
        self.found = self.masked = 0
        self.missing: list[tuple[str, str]] = []  # name and field

    def find(self, name: str, field: str) -> ImageFile | None:
        """The image `name`, None where it is not there. Raises `CaptureError` where it cannot be used."""
        image = self.folder.find_image(name, source=self.source, field=field)
        if image is None:
            self.missing.append((name, field))
        else:
            self.found += 1
        return image

    def mask(self, name: str, image: ImageFile, field: str) -> ImageFile:
        """The mask `name` of `image`. Raises `CaptureError` where it is missing or of another shape."""
        mask = self.folder.image(name, source=self.source, field=field)
        check_mask(mask, image)
        self.masked += 1
        return mask

    def notes(self, *, optional: bool = False) -> list[str]:
        """What was left out or ignored. Raises `CaptureError` where many images are missing.

        With `optional` all may be: some programs list pictures of a split that are never rendered.
        """
        notes = []
        listed = self.found + len(self.missing)
        if self.missing:
            name, field = self.missing[0]
            if optional and not self.found:
                return [f"{self.source} is left out: none of its {listed} images is there (first: {name})"]
            if len(self.missing) > MAX_MISSING * listed:
                more = f", as are {len(self.missing) - 1} more of {listed}" if len(self.missing) > 1 else ""
                folder = name.replace("\\", "/").rpartition("/")[0] or "."
                raise CaptureError(
                    f"the image {name!r} is missing{more}; looked in the folder {folder!r} of the capture, also for "
                    "other suffixes and spellings",
                    file=self.source,
                    field=field,
                    remedy="Add the images or remove their entries.",
                )
            names = ", ".join(name for name, _ in self.missing[:NAMED]) + (", …" if len(self.missing) > NAMED else "")
            share = len(self.missing) / listed
            notes.append(
                f"{len(self.missing)} of {listed} images of {self.source} ({share:.0%}) are missing and left out: "
                f"{names}"
            )
        if self.masked:
            notes.append(
                f"{self.masked} of {self.found} images of {self.source} have a mask: black pixels of it take part in "
                "no loss, no metric and no first point"
            )
        return notes

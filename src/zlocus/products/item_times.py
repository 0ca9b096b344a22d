"""When the images of a surface were taken, as an item of a catalogue says it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, time
from pathlib import Path
from typing import Any

from zlocus.io.run_record import read_record

DESCRIPTION = "Heights from overlapping images, by zlocus."
FIRST, LAST = time(0, 0, 0), time(23, 59, 59)


@dataclass(frozen=True)
class ItemTimes:
    """Times of an item.

    created : when the surface was made; description : of the item, which says where its times are from; first, last :
    of the images, None where no date is known; images : what is known of each image, by the names that STAC has for it;
    platform : of all images, None where they have several or it is not known.
    """

    created: datetime
    description: str
    first: datetime | None = None
    last: datetime | None = None
    images: list[dict[str, Any]] = field(default_factory=list)
    platform: str | None = None

    def properties(self) -> dict[str, Any]:
        """The times as properties of an item: a range, or the time of the run where nothing is known of the images."""
        if self.first is None or self.last is None:
            return {"datetime": rfc3339(self.created)}
        known: dict[str, Any] = {
            "datetime": None, "start_datetime": rfc3339(self.first), "end_datetime": rfc3339(self.last),
        }  # fmt: skip
        if self.platform is not None:
            known["platform"] = self.platform
        return known | ({"zlocus:images": self.images} if self.images else {})


def item_times(folder: Path) -> ItemTimes:
    """Times of the images and of the run from run.json of a surface; without one, when the surface was written.

    An image of which only the day is known was taken within it, in UTC.
    """
    record: dict[str, Any] = read_record(folder / "run.json") if (folder / "run.json").is_file() else {}
    if "created" in record:
        created = datetime.fromisoformat(record["created"])
    else:
        created = datetime.fromtimestamp(int((folder / "dsm.tif").stat().st_mtime), UTC)
    taken: Mapping[str, Mapping[str, Any]] = record.get("acquisitions", {})
    spans = list(_spans(record, taken))
    if not spans:
        return ItemTimes(created, f"{DESCRIPTION} The dates of the images are not known: datetime is that of the run.")
    n_images, description = len(record.get("image_dates", spans)), DESCRIPTION
    if len(spans) < n_images:
        description += f" The dates of {n_images - len(spans)} of {n_images} images are not known."
    satellites = {known.get("satellite") for known in taken.values()}
    is_one = len(satellites) == 1 and len(taken) == n_images
    return ItemTimes(
        created, description, min(first for first, _ in spans), max(last for _, last in spans),
        [_image(name, known) for name, known in taken.items()], satellites.pop() if is_one else None,
    )  # fmt: skip


def rfc3339(when: datetime) -> str:
    """A time in UTC as RFC 3339 writes it, with microseconds where there are any."""
    return when.astimezone(UTC).isoformat().replace("+00:00", "Z")


def _spans(record: Mapping[str, Any], taken: Mapping[str, Mapping[str, Any]]) -> Iterator[tuple[datetime, datetime]]:
    """Between which times each image was taken whose date is known."""
    exact = [known["time"] for known in taken.values() if known.get("time")]
    for moment in exact:
        yield _utc(moment), _utc(moment)
    days = [day for day in record.get("image_dates", []) if day]
    of_exact = [known.get("date") or known["time"][:10] for known in taken.values() if known.get("time")]
    for day in of_exact:  # each image counts once
        if day in days:
            days.remove(day)
    for day in days:
        on = date.fromisoformat(day)
        yield datetime.combine(on, FIRST, UTC), datetime.combine(on, LAST, UTC)


def _image(name: str, known: Mapping[str, Any]) -> dict[str, Any]:
    """What is known of an image. Its time is exact, or its day is known."""
    when = rfc3339(_utc(known["time"])) if known.get("time") else None
    said = {"name": name, "datetime": when, "date": known.get("date"), "platform": known.get("satellite")}
    if when is not None:
        del said["date"]
    return {key: value for key, value in said.items() if value is not None}


def _utc(text: str) -> datetime:
    """A recorded time. Without a zone it is in UTC."""
    when = datetime.fromisoformat(text)
    return when if when.tzinfo is not None else when.replace(tzinfo=UTC)

"""Read what is in local archives (ZIP and TAR) in place: the paths are those of GDAL's `/vsizip/` and `/vsitar/`.

An archive may come from people who are not trusted. Its table of contents is checked as a whole before anything in it
is read: it has a bounded number of members and a bounded size, no member leaves the archive by its name, is a link or
is encrypted, and no two members share their bytes.
"""

from __future__ import annotations

import functools
import gzip
import itertools
import stat
import tarfile
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted

ZIP_SUFFIXES, TAR_SUFFIXES = (".zip",), (".tar", ".tgz", ".tar.gz")
ZIP_SYSTEM, TAR_SYSTEM = "vsizip", "vsitar"
# How files of each kind begin; the last one is the mark of an empty ZIP.
ZIP_MAGIC, GZIP_MAGIC, TAR_MAGIC, TAR_MAGIC_AT = (b"PK\x03\x04", b"PK\x05\x06"), b"\x1f\x8b", b"ustar", 257
# A delivery of a whole country in tiles has ten thousand files.
MAX_MEMBERS = 100_000
# Images shrink by a factor of two to ten, and empty ones by some hundreds. Members that would take less than
# `SMALL_BYTES` when they are unpacked may shrink by any factor.
MAX_RATIO, SMALL_BYTES = 500, 256 << 20
# Twenty times the largest delivery of one strip with all its bands.
MAX_UNPACKED_BYTES = 4 << 40
ADVICE = "Get the archive from its source again, or unpack it by other means and give the folder."


@dataclass(frozen=True)
class Member:
    """A file in an archive. name : its path there, with slashes; n_bytes : its size when unpacked; is_packed : whether
    it is compressed, so that parts of it cannot be read without what lies before them; offset : of its first byte in
    the unpacked TAR, 0 in a ZIP."""

    name: str
    n_bytes: int
    is_packed: bool
    offset: int = 0


def is_archive(path: Path) -> bool:
    """Whether the name of a file is that of an archive that can be read in place."""
    return path.name.lower().endswith(ZIP_SUFFIXES + TAR_SUFFIXES)


def is_archived(path: Path) -> bool:
    """Whether a path names something in a local archive: `/vsizip/delivery.zip/images/a.tif`."""
    return len(path.parts) > 2 and path.parts[0] == "/" and path.parts[1] in (ZIP_SYSTEM, TAR_SYSTEM)


def path_in_archive(archive: Path, name: str = "") -> Path:
    """The path of a member of an archive, or of its root."""
    system = ZIP_SYSTEM if archive.name.lower().endswith(ZIP_SUFFIXES) else TAR_SYSTEM
    return Path(f"/{system}/{archive}" + (f"/{name}" if name else ""))


def archive_name(path: Path) -> str:
    """What GDAL opens for a path in an archive.

    That of a ZIP has two slashes before an absolute path of the archive. Of a TAR it is a part of the whole file,
    because GDAL does not know all kinds of long names in these archives.
    """
    archive, name = _parts(path)
    member = _by_name(archive).get(name)
    if path.parts[1] == ZIP_SYSTEM or member is None:
        return f"/{path.parts[1]}/{archive}/{name}"
    whole = f"/vsigzip/{archive}" if member.is_packed else str(archive)
    return f"/vsisubfile/{member.offset}_{member.n_bytes},{whole}"


def stored_file(path: Path) -> Path:
    """The file on this machine in which the bytes of a path are: the path itself, or the archive in which it lies.

    Raises
    ------
    InputError
        There is no archive on the path.
    """
    return _parts(path)[0] if is_archived(path) else path


def absolute_path(path: Path) -> Path:
    """A path that starts at the root of the file system; in an archive, that of the archive does."""
    if not is_archived(path):
        return path.resolve()
    archive, name = _parts(path)
    return path_in_archive(archive.resolve(), name)


def members(archive: Path) -> tuple[Member, ...]:
    """The files in an archive, in order of their names.

    Raises
    ------
    InputError
        The archive cannot be read, or has a table of contents that is not accepted.
    """
    try:
        status = archive.stat()
    except OSError as error:
        raise InputError(f"The archive {archive} cannot be read: {error.strerror}. Check the path.") from error
    return _members(archive, status.st_size, status.st_mtime_ns)


def member_of(path: Path) -> Member | None:
    """The member that a path names; None where there is no such file in the archive."""
    archive, name = _parts(path)
    return _by_name(archive).get(name)


def is_folder_in_archive(path: Path) -> bool:
    """Whether a path names a folder in an archive, or its root."""
    archive, name = _parts(path)
    return any(not name or each.name.startswith(f"{name}/") for each in members(archive))


def names_in_archive(path: Path) -> list[str]:
    """Names of the files in the folder of an archive in which a path lies."""
    archive, name = _parts(path)
    folder = PurePosixPath(name).parent
    return [at.name for each in members(archive) if (at := PurePosixPath(each.name)).parent == folder]


def read_member(path: Path, max_bytes: int) -> bytes:
    """The first bytes of a member of an archive, at most `max_bytes`.

    Raises
    ------
    InputError
        There is no such member, or it cannot be unpacked.
    """
    archive, name = _parts(path)
    if name not in _by_name(archive):
        raise InputError(f"{archive} holds no file {quoted(name)}. Check the path.")
    try:
        if archive.name.lower().endswith(ZIP_SUFFIXES):
            with zipfile.ZipFile(archive) as opened, opened.open(name) as file:
                return file.read(max_bytes)
        member = _by_name(archive)[name]
        with gzip.open(archive) if member.is_packed else archive.open("rb") as whole:
            whole.seek(member.offset)
            return whole.read(min(max_bytes, member.n_bytes))
    except (
        OSError,
        EOFError,
        KeyError,
        zipfile.BadZipFile,
        tarfile.TarError,
        NotImplementedError,
        RuntimeError,
    ) as error:
        raise InputError(f"{quoted(name)} in {archive} cannot be unpacked: {error}. {ADVICE}") from error


def _parts(path: Path) -> tuple[Path, str]:
    """The archive of a path, and the name of the member; the name is empty for the root of the archive."""
    parts = path.parts[2:]
    # `Path` has made one slash of the two that GDAL writes before an absolute path.
    for root in (Path("/"), Path()):
        for number in range(1, len(parts) + 1):
            archive = root.joinpath(*parts[:number])
            if is_archive(archive) and archive.is_file():
                return archive, "/".join(parts[number:])
    raise InputError(f"There is no archive on the path {quoted(str(path))}. Check the path.")


@functools.lru_cache(maxsize=64)
def _by_name_of(archive: Path, size: int, time_ns: int) -> dict[str, Member]:
    return {each.name: each for each in _members(archive, size, time_ns)}


def _by_name(archive: Path) -> dict[str, Member]:
    status = archive.stat()
    return _by_name_of(archive, status.st_size, status.st_mtime_ns)


@functools.lru_cache(maxsize=64)
def _members(archive: Path, size: int, time_ns: int) -> tuple[Member, ...]:
    """See `members`. size, time_ns : of the file, so that a changed archive is read again."""
    del time_ns
    try:
        _check_kind(archive, size)
        found = _zip_members(archive) if archive.name.lower().endswith(ZIP_SUFFIXES) else _tar_members(archive)
    except (OSError, EOFError, zlib.error, zipfile.BadZipFile, tarfile.TarError, ValueError) as error:
        if isinstance(error, EOFError) or str(error) == "unexpected end of data":
            raise InputError(f"{archive} is cut short: it ends within one of its files. {ADVICE}") from error
        why = str(error).partition("\n")[0].rstrip(".:")
        raise InputError(f"{archive} cannot be read as an archive: {why}. {ADVICE}") from error
    _check_size(archive, sum(each.n_bytes for each in found), size)
    for number, each in enumerate(found):
        if number and each.name == found[number - 1].name:
            raise InputError(f"{archive} holds {quoted(each.name)} twice. {ADVICE}")
    return tuple(found)


def _check_kind(archive: Path, size: int) -> None:
    """Refuse a file whose content is not what its name says, or that is cut short, and say so."""
    if size == 0:
        raise InputError(f"{archive} is empty: it has no bytes. {ADVICE}")
    with archive.open("rb") as file:
        head = file.read(TAR_MAGIC_AT + len(TAR_MAGIC))
    is_named_zip = archive.name.lower().endswith(ZIP_SUFFIXES)
    kinds = {
        "ZIP": head.startswith(ZIP_MAGIC), "TAR": head[TAR_MAGIC_AT:] == TAR_MAGIC,
        "compressed TAR": head.startswith(GZIP_MAGIC),
    }  # fmt: skip
    kind = next((kind for kind, is_it in kinds.items() if is_it), None)
    if kind is not None and (kind == "ZIP") != is_named_zip:
        suffix = {"ZIP": ".zip", "TAR": ".tar"}.get(kind, ".tar.gz")
        raise InputError(f"{archive} is a {kind} archive by its content. Rename it, so that its name ends in {suffix}.")
    if kind == "ZIP" and not zipfile.is_zipfile(archive):
        raise InputError(f"{archive} is cut short: the list of its files, at the end of a ZIP, is missing. {ADVICE}")


def _zip_members(archive: Path) -> list[Member]:
    found, places = [], []
    with zipfile.ZipFile(archive) as opened:
        entries = opened.infolist()
        _check_number(archive, len(entries))
        for entry in entries:
            _check_name(archive, entry.filename)
            mode = entry.external_attr >> 16
            if mode and stat.S_ISLNK(mode):
                raise InputError(f"{archive} holds {quoted(entry.filename)}, which is a link. {ADVICE}")
            if entry.is_dir():
                continue
            if entry.flag_bits & 1:
                raise InputError(f"{quoted(entry.filename)} in {archive} is encrypted. Unpack it, and give the folder.")
            if entry.file_size > max(SMALL_BYTES, MAX_RATIO * entry.compress_size):
                raise InputError(
                    f"{quoted(entry.filename)} in {archive} would unpack {entry.compress_size} bytes to "
                    f"{entry.file_size}, as no image does. {ADVICE}"
                )
            places.append((entry.header_offset, entry.header_offset + entry.compress_size, entry.filename))
            found.append(Member(entry.filename, entry.file_size, entry.compress_type != zipfile.ZIP_STORED))
    places.sort()
    for (_, end, _), (begin, _, name) in itertools.pairwise(places):
        if begin < end:
            raise InputError(f"{archive} is damaged: the bytes of {quoted(name)} are those of another file. {ADVICE}")
    return sorted(found, key=lambda each: each.name)


def _tar_members(archive: Path) -> list[Member]:
    found, total, size = list[Member](), 0, archive.stat().st_size
    is_packed = not archive.name.lower().endswith(".tar")
    with tarfile.open(archive) as opened:
        for number, entry in enumerate(opened, 1):
            _check_number(archive, number)
            _check_name(archive, entry.name)
            if entry.isdir():
                continue
            if not entry.isreg():
                what = "a link" if entry.issym() or entry.islnk() else "no file"
                raise InputError(f"{archive} holds {quoted(entry.name)}, which is {what}. {ADVICE}")
            found.append(Member(entry.name.removeprefix("./"), entry.size, is_packed, entry.offset_data))
            # The next entry is found behind the content of this one, which has to be unpacked for that.
            total += entry.size
            _check_size(archive, total, size)
    return sorted(found, key=lambda each: each.name)


def _check_number(archive: Path, number: int) -> None:
    if number > MAX_MEMBERS:
        raise InputError(f"{archive} holds more than {MAX_MEMBERS} files. Unpack it, and give the folder of one strip.")


def _check_name(archive: Path, name: str) -> None:
    """Refuse a name that would lie outside the folder to which the archive is unpacked."""
    at = PurePosixPath(name)
    leaves = at.is_absolute() or ".." in at.parts or "\\" in name or ":" in name.split("/")[0]
    if leaves or any(ord(sign) < 32 for sign in name):
        raise InputError(f"{archive} holds a file of the name {quoted(name)}, which leaves the archive. {ADVICE}")


def _check_size(archive: Path, n_bytes: int, size: int) -> None:
    """Refuse an archive of `size` bytes whose files take more than any delivery would."""
    if n_bytes > max(SMALL_BYTES, MAX_RATIO * size):
        raise InputError(f"{archive} would unpack {size} bytes to {n_bytes}, as no delivery of images does. {ADVICE}")
    if n_bytes > MAX_UNPACKED_BYTES:
        raise InputError(
            f"{archive} would take {n_bytes / 1e12:.0f} TB when unpacked. Unpack the strips that you need."
        )

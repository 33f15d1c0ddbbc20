"""The public drive of `segfloor demo --real`, fetched from a server on this machine."""

import json
import sys
import zipfile
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import cv2
import pytest
from command_line import segfloor
from stereo_drive import room_drive
from stereo_room import CAMERA

from segfloor_ros.apps.suite import public_drive
from segfloor_ros.apps.suite.public_drive import fetched
from segfloor_ros.core.errors import InputError

pytest.importorskip('aiohttp', reason='URLs need the extra cluster')
registry = pytest.importorskip('fsspec.registry')

PAIRS = 6


class Archives(SimpleHTTPRequestHandler):
    """Serves parts of files, as stores of archives do. ends_after: of the images, in bytes."""

    ends_after: int | None = None
    sent = 0

    def log_message(self, *_: object) -> None:
        """Stay silent."""

    def do_GET(self) -> None:
        """Send the part that is asked for."""
        if not (path := Path(self.translate_path(self.path))).is_file():
            return self.send_error(404)
        content = path.read_bytes()
        first, _, last = self.headers['Range'].removeprefix('bytes=').partition('-')
        part = content[int(first) : int(last) + 1]
        self.send_response(206)
        self.send_header('Content-Range', f'bytes {first}-{last}/{len(content)}')
        self.send_header('Content-Length', str(len(part)))
        self.end_headers()
        Archives.sent += len(part)
        if Archives.ends_after is not None and Archives.sent > Archives.ends_after:
            self.wfile.write(part[: len(part) // 2])
            self.close_connection = True
        else:
            self.wfile.write(part)


@pytest.fixture
def archives(tmp_path, monkeypatch) -> Iterator[Path]:
    """The folder of a server with both archives, whose drive goes on after what is wanted."""
    root = tmp_path / 'server'
    monkeypatch.setattr(public_drive, 'PAIRS', PAIRS)
    monkeypatch.setattr(public_drive, 'BLOCK_BYTES', 1 << 15)
    monkeypatch.setattr(Archives, 'ends_after', None)
    monkeypatch.setattr(Archives, 'sent', 0)
    frames, _ = room_drive(PAIRS + 2)
    calibration = ''
    for camera in range(4):
        P = [*CAMERA.K.ravel()]
        P = [*P[:3], -CAMERA.disparity_times_depth * (camera % 2), *P[3:6], 0, *P[6:], 0]
        calibration += f'S_rect_{camera:02d}: {CAMERA.width} {CAMERA.height}\n'
        calibration += f'S_{camera:02d}: {CAMERA.width} {CAMERA.height}\n'
        calibration += f'K_{camera:02d}: {" ".join(map(str, CAMERA.K.ravel()))}\n'
        calibration += f'D_{camera:02d}: 0 0 0 0 0\nR_rect_{camera:02d}: 1 0 0 0 1 0 0 0 1\n'
        calibration += f'P_rect_{camera:02d}: {" ".join(map(str, P))}\n'
    for url, names in public_drive.files_by_url().items():
        path = root / url.removeprefix(f'{public_drive.ARCHIVES}/')
        path.parent.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(path, 'w') as archive:
            if names[0].endswith('cam.txt'):
                archive.writestr(names[0], calibration)
                continue
            times = [
                f'2011-09-30 12:17:5{3 + k // 10}.{k % 10}00000000\n' for k in range(PAIRS + 2)
            ]
            archive.writestr(names[0], ''.join(times))
            for frame in frames:
                for side, image in (('00', frame.left), ('01', frame.right)):
                    name = (
                        f'{Path(names[0]).parent.parent}/image_{side}/data/{frame.index:010d}.png'
                    )
                    archive.writestr(name, cv2.imencode('.png', image)[1].tobytes())
    server = ThreadingHTTPServer(('127.0.0.1', 0), partial(Archives, directory=str(root)))
    monkeypatch.setattr(public_drive, 'ARCHIVES', f'http://127.0.0.1:{server.server_port}')
    Thread(target=server.serve_forever, daemon=True).start()
    yield root
    server.shutdown()
    server.server_close()


def images_in(folder: Path) -> int:
    return len(list(folder.rglob('*.png')))


def test_only_what_is_wanted_is_fetched_and_mapped(archives, tmp_path) -> None:
    made = segfloor(
        'demo', '--real', '--lockstep', '--data', tmp_path / 'k', '--out', tmp_path / 'o'
    )
    assert made.returncode == 0, made.stderr
    assert 'CC BY-NC-SA 3.0' in made.stdout
    assert images_in(tmp_path / 'k') == 2 * PAIRS
    assert json.loads((tmp_path / 'o' / 'summary.json').read_text())['frames'] == PAIRS
    assert (tmp_path / 'o' / 'report.html').is_file()
    assert not list((tmp_path / 'k').glob('.segfloor-*'))
    for path in archives.rglob('*.zip'):  # once fetched, no network is needed
        path.unlink()
    assert fetched(tmp_path / 'k').is_dir()


def test_a_transfer_that_is_cut_off_is_resumed(archives, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(Archives, 'ends_after', 500_000)
    with pytest.raises(InputError, match=r'_sync\.zip: cannot be read .*; what came is kept'):
        fetched(tmp_path)
    kept = images_in(tmp_path / public_drive.DAY)
    assert 0 < kept < 2 * PAIRS
    monkeypatch.setattr(Archives, 'ends_after', None)
    monkeypatch.setattr(Archives, 'sent', 0)
    counts: list[int] = []
    fetched(tmp_path, counts.append)
    assert images_in(tmp_path / public_drive.DAY) == 2 * PAIRS
    assert counts[-1] == 2 * PAIRS + 2
    assert counts[1] == kept + 2, 'what was there was fetched again'


def test_a_file_of_another_checksum_is_refused(archives, tmp_path) -> None:
    (path,) = archives.rglob('*_sync.zip')
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        damaged = archive.infolist()[5]
    content[damaged.header_offset + 200] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"Bad CRC-32 for file '.*/image_00/data/0000000002\.png'"):
        fetched(tmp_path)
    assert not (tmp_path / damaged.filename).exists()


def test_without_network_one_line_says_what_to_do(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(public_drive, 'ARCHIVES', 'http://127.0.0.1:9')
    failed = segfloor('demo', '--real', '--data', tmp_path / 'k', '--out', tmp_path / 'o')
    assert failed.returncode == 2
    (line,) = failed.stderr.strip().splitlines()
    assert 'http://127.0.0.1:9/2011_09_30_calib.zip: cannot be read (Cannot connect to host' in line
    assert 'not found' not in line
    assert 'is kept' not in line, 'nothing came'
    assert all(url in line for url in public_drive.files_by_url())
    assert line.endswith(f'by other means and unpack both in {tmp_path}/k')
    assert not (tmp_path / 'o').exists()


def test_an_archive_that_is_gone_is_named(archives, tmp_path) -> None:
    (path,) = archives.rglob('*_calib.zip')
    path.unlink()
    with pytest.raises(InputError, match=r'_calib\.zip: cannot be read \(not found\); try again'):
        fetched(tmp_path)


def test_a_server_that_has_no_address_is_not_called_a_missing_file(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(public_drive, 'ARCHIVES', 'http://nowhere.invalid')
    with pytest.raises(InputError, match=r'cannot be read \(Cannot connect to host nowhere\.inv'):
        fetched(tmp_path)


def test_a_file_that_is_there_stays(archives, tmp_path) -> None:
    mine = tmp_path / public_drive.DAY / 'calib_cam_to_cam.txt'
    mine.parent.mkdir()
    mine.write_text('mine')
    fetched(tmp_path)
    assert mine.read_text() == 'mine'


def test_a_link_to_nothing_stays(archives, tmp_path) -> None:
    mine = tmp_path / public_drive.FOLDER / 'image_00' / 'data' / '0000000001.png'
    mine.parent.mkdir(parents=True)
    mine.symlink_to(tmp_path / 'disk' / 'mine.png')
    fetched(tmp_path)
    assert mine.is_symlink()
    assert not mine.exists()


def test_a_file_that_appears_meanwhile_stays(archives, tmp_path) -> None:
    mine = tmp_path / public_drive.FOLDER / 'image_00' / 'data' / '0000000001.png'

    def appear(count: int) -> None:
        if count == 3:
            mine.write_text('mine')

    with pytest.raises(
        InputError, match=r'0000000001\.png: cannot be written \(File exists\)'
    ) as no:
        fetched(tmp_path, appear)
    assert 'http' not in str(no.value)
    assert mine.read_text() == 'mine'
    assert not list(tmp_path.glob('.segfloor-*'))


def test_a_folder_that_cannot_be_written_does_not_blame_the_server(archives, tmp_path) -> None:
    (tmp_path / public_drive.DAY).write_text('mine')
    with pytest.raises(InputError, match=rf'^{tmp_path}/.*: cannot be written \(.*--data$') as no:
        fetched(tmp_path)
    assert 'http' not in str(no.value)


def test_both_sides_have_their_own_images(archives, tmp_path) -> None:
    drive = fetched(tmp_path)
    (path,) = archives.rglob('*_sync.zip')
    with zipfile.ZipFile(path) as archive:
        for file in drive.rglob('*.png'):
            assert file.read_bytes() == archive.read(str(file.relative_to(tmp_path)))


def test_a_folder_named_kitti_is_not_taken_for_parameters(archives, tmp_path, monkeypatch) -> None:
    (tmp_path / 'kitti').mkdir()
    monkeypatch.chdir(tmp_path)
    made = segfloor('demo', '--real', '--lockstep', '--out', 'o')
    assert made.returncode == 0, made.stderr
    assert images_in(tmp_path / 'segfloor_kitti') == 2 * PAIRS


@pytest.mark.parametrize(
    ('options', 'complaint'),
    [
        (('--real', '--out', 'full'), 'full: holds files'),
        (('--real', '--out', '.'), '.: is, holds or lies in segfloor_kitti/2011'),
        (('--real', '--out', 'new', '--data', 'new'), 'new: is, holds or lies in new/2011'),
        (('--real', '--out', 'file/o'), 'file/o: cannot be written'),
        (('--real', '--rate', '-1'), 'rate'),
        (('--real', '--rate', 'nan'), 'rate'),
        (('--data', 'k'), '--data: only --real'),
    ],
)
def test_what_cannot_be_done_is_said_before_anything_is_fetched(
    archives, tmp_path, monkeypatch, options, complaint
) -> None:
    (tmp_path / 'full').mkdir()
    (tmp_path / 'full' / 'mine').touch()
    (tmp_path / 'file').touch()
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    refused = segfloor('demo', *options)
    (line,) = refused.stderr.strip().splitlines()
    assert refused.returncode == 2
    assert complaint in line
    assert (Archives.sent, sorted(tmp_path.iterdir())) == (0, before)


def test_a_library_that_is_missing_is_named_with_its_extra(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, 'aiohttp', None)
    monkeypatch.delitem(sys.modules, 'fsspec.implementations.http', raising=False)
    monkeypatch.delitem(registry._registry, 'http', raising=False)
    monkeypatch.setattr(public_drive, 'ARCHIVES', 'http://127.0.0.1:9')
    with pytest.raises(InputError, match=r"aiohttp.*pip install 'segfloor_ros\[cluster\]'$"):
        fetched(tmp_path)

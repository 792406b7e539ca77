"""One measurement of an actuator: voltage in, displacement out, sampled at a steady rate.

A :class:`Record` is what every file is read into and what every later step starts from. Its units
are volts, micrometers and seconds, its arrays cannot be written to, and its :attr:`Record.sha256`
names the data exactly. Parts of a record are addressed by time: a window is the pair (start, stop).
The voltage is known at every sample, since it drives the simulation; a displacement may be missing
(nan), and missing readings are not scored.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from bwbayes.arrays import ArrayLike, BoolArray, FloatArray, IntArray
from bwbayes.errors import InputError, one_line
from bwbayes.model.inputs import Inputs, VoltageIs, require_voltage_is
from bwbayes.quantities import DISPLACEMENT, VOLTAGE
from bwbayes.record.instruments import EXACT, Instruments
from bwbayes.record.io.columns import Naming, select
from bwbayes.record.io.fields import record_fields
from bwbayes.record.io.grid import clock
from bwbayes.record.io.recognition import QUANTITIES
from bwbayes.record.io.series import Source, array_source, frame_source
from bwbayes.record.voltage_path import VoltagePath, estimate_path, with_corners
from bwbayes.shown import brief

Window = tuple[float, float]
"""A stretch of time in s: start <= time < stop."""


@dataclass(frozen=True, eq=False)
class Record(Inputs):
    """Inputs and displacement on the uniform time grid ``start + interval * arange(samples)``.

    Parameters
    ----------
    voltage : array (samples,), V
    displacement : array (samples,), um, or None
        nan where the reading is missing; None for a planned voltage without a measurement.
    interval : float, s
        Sampling interval.
    start : float, s
        Time of the first sample.
    voltage_is : "command" or "output"
        Kind of the voltage column: the command that a DAC holds until the next sample, or the
        amplifier's output, which is continuous.
    covariates : dict of arrays (samples,)
        Further columns that may act on the actuator, one value a sample, by name.
    quantities : Quantities
        Quantities and units of ``voltage`` and ``displacement``, if they are others.
    origin : str
        Where the record comes from: a file's name or free text. Line breaks and other characters
        that do not print become blanks.
    truth : array (samples,), um, or None
        Noise-free displacement, known for simulated records only.
    time_offset : float, s
        Offset of the clock, to be added to the record's times, which count from about its first
        sample: the time stamp of time zero.
    instruments : Instruments
        Uncertainties of the scales of sensor and voltage monitor.
    corners : bool
        Whether a model's voltage reaches the corners that fall between samples; the model's
        ``hold`` decides.
    read_as : dict
        Names in the file that it was read from: of its ``columns`` by quantity, ``all_columns``.

    Raises
    ------
    InputError
        If an array is not a vector of finite numbers (one is enough in the displacement), lengths
        differ, the interval is not a positive number, or `voltage_is` is unknown.

    Examples
    --------
    >>> record = Record([0.0, 5.0, 10.0], [0.0, np.nan, 6.1], interval=0.01)
    >>> record.samples, record.readings, record.duration
    (3, 2, 0.03)
    """

    __repr__ = brief

    displacement: FloatArray | None
    _: KW_ONLY
    origin: str = ""
    truth: FloatArray | None = None
    time_offset: float = 0.0
    instruments: Instruments = EXACT
    corners: bool = False
    read_as: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        samples = np.size(self.voltage)
        for name in ("voltage", "displacement", "truth"):
            values = getattr(self, name)
            if values is not None:
                object.__setattr__(self, name, _frozen(name, values, samples))
        covariates = {n: _frozen(n, values, samples) for n, values in self.covariates.items()}
        object.__setattr__(self, "covariates", covariates)
        if not (math.isfinite(self.interval) and self.interval > 0):
            raise InputError(f"interval: {self.interval} s is not a positive time; give it in s")
        if not math.isfinite(self.start):
            raise InputError(f"start: {self.start} s is not a time; give it in s")
        object.__setattr__(self, "interval", float(self.interval))
        object.__setattr__(self, "start", float(self.start) + 0.0)  # turns -0.0 into 0.0
        object.__setattr__(self, "time_offset", float(self.time_offset))
        object.__setattr__(self, "voltage_is", require_voltage_is(self.voltage_is))
        object.__setattr__(self, "origin", one_line(self.origin))

    @classmethod
    def from_arrays(
        cls,
        voltage: ArrayLike,
        displacement: ArrayLike | None = None,
        *,
        interval: float | None = None,
        start: float | None = None,
        time: ArrayLike | None = None,
        units: Mapping[str, str] | None = None,
        covariates: Mapping[str, ArrayLike] | None = None,
        input: str | None = None,
        output: str | None = None,
        voltage_is: VoltageIs = "output",
        origin: str = "arrays",
    ) -> Self:
        """Return the record of a voltage and a displacement, checked as a file is.

        Parameters
        ----------
        voltage, displacement : arrays (samples,), (samples, 1) or (1, samples), V and um
            The displacement is nan where a reading is missing, and None for a planned voltage.
        interval, start : float, s
            Sampling interval, and time of the first sample (default: 0).
        time : array as these, s
            Times of the samples, in place of interval and start; dates and durations too.
        units : dict
            Units by quantity, where they are others: ``{"displacement": "nm", "time": "ms"}``;
            ``"-nm"`` turns the sign, ``"0.35 um"`` is a sensor's sensitivity, that of 1, and
            ``"0.35 +- 0.004 um"`` or ``"um +- 1.2 %"`` one with its standard uncertainty.
        covariates : dict of arrays as these
            Other measured quantities that a model may use: ``{"temperature_degC": temperature}``.
        input, output : str
            Input and output quantity, if not a voltage and a displacement: ``"H (A/m)"`` and
            ``"B (T)"``; then neither interval nor time is needed, and units are by these names.

        Raises
        ------
        InputError
            For every reason to refuse a file; or if neither interval nor time is given, or both.

        Warns
        -----
        InputWarning
            If samples are missing between the times, or they are not uniform.

        Examples
        --------
        >>> ms, sine = np.arange(1000.0), np.sin(np.arange(1000.0))
        >>> units = {"time": "ms", "displacement": "nm"}
        >>> record = Record.from_arrays(sine, 700 * sine, time=ms, units=units)
        >>> record.interval, round(float(record.displacement.max()), 3)
        (0.001, 0.7)
        """
        is_loop = bool(input or output) and time is interval is start is None
        is_sampled = (time is None) != (interval is None) and (time is None or start is None)
        if not is_loop and not is_sampled:
            raise InputError(f"{origin}: give either interval (and start), in s, or time, a vector")
        if time is None and "time" in (units or {}):
            raise InputError(f"{origin}: units: interval is in s; leave out that of the time")
        if interval is not None and not 0 < interval < np.inf:
            raise InputError(f"{origin}: interval: {interval} s is not a positive time")
        stated_naming = Naming.stated(
            units=units, covariates=tuple(covariates or ()), input=input, output=output
        )
        quantities = stated_naming.quantities
        names = quantities.input.name, quantities.output.name
        arrays = {"time": time, names[0]: voltage, names[1]: displacement}
        source = array_source(origin, arrays | dict(covariates or {}), interval, start or 0.0)
        common = {"time": "s", "voltage": "V", "displacement": "um"}
        if quantities.input != VOLTAGE:
            del common["voltage"]
        if quantities.output != DISPLACEMENT:
            del common["displacement"]
        columns: dict[str, str | int] = {}
        if not quantities.are_default:
            columns = {"voltage": names[0]}
            columns |= {} if displacement is None else {"displacement": names[1]}
        naming = replace(stated_naming, units=common | dict(stated_naming.units), columns=columns)
        return cls._of(source, naming, voltage_is, displacement is not None)

    @classmethod
    def from_pandas(
        cls,
        frame: Any,
        *,
        time: str | None = None,
        voltage: str | None = None,
        displacement: str | None = None,
        units: dict[str, str] | None = None,
        fs: float | None = None,
        covariates: Mapping[str, str] | Sequence[str] = (),
        input: str | None = None,
        output: str | None = None,
        voltage_is: VoltageIs = "output",
        origin: str = "DataFrame",
    ) -> Self:
        """Return the record of a pandas table, whose time column gives the sampling interval.

        Parameters
        ----------
        frame : pandas.DataFrame
            A column each for time, voltage and displacement; without the last one it is a planned
            voltage. The time may be the index; dates count from the first sample.
        time, voltage, displacement : str
            The columns' names, if they are neither ``time_s``, ``voltage_mV`` and the like, nor can
            be recognized as those of a file are.
        units : dict
            Units by quantity, ``{"displacement": "nm"}``, where the names do not say them.
        fs : float, Hz
            The sampling rate, in place of a time column.
        covariates : dict or list of str
            Further columns that a model may use, by name, as for :func:`read_record`.
        input, output : str
            Input and output quantity, as for :func:`read_record`.

        Raises and warns as :func:`read_record` does.
        """
        names = {"time": time, "voltage": voltage, "displacement": displacement}
        columns = {quantity: name for quantity, name in names.items() if name is not None}
        naming = Naming.stated(
            columns=columns, units=units, fs=fs, covariates=covariates, input=input, output=output
        )
        return cls._of(frame_source(frame, origin), naming, voltage_is, displacement is not None)

    @classmethod
    def _of(
        cls, source: Source, naming: Naming, voltage_is: VoltageIs, need_displacement: bool
    ) -> Self:
        needed = QUANTITIES if need_displacement else ("time", "voltage")
        with naming.quantities.spoken():
            table = select(source, naming, needed)
            return cls(**record_fields(table, require_voltage_is(voltage_is), need_displacement))

    @cached_property
    def path(self) -> VoltagePath:
        """The voltage that drives a model: the measured one without its noise.

        A command, and a planned voltage without a displacement, have no noise. A voltage without
        noise, but no command, may reach its ``corners``.
        """
        path = VoltagePath(self.voltage)
        if self.voltage_is == "command":
            return path
        if self.displacement is not None:
            path = estimate_path(self.voltage)
        if self.corners and not path.noise_sd:
            path = replace(path, voltage=with_corners(self.voltage))
        return path

    @property
    def usable_displacement(self) -> FloatArray | None:
        """The displacement (samples,), um, that a model of the path can follow; else it is nan.

        Where the path reaches a corner, a reading is that of the sample beside it.
        """
        if not self.corners or self.displacement is None or self.path.noise_sd:
            return self.displacement
        return np.where(self.path.voltage == self.voltage, self.displacement, np.nan)

    @cached_property
    def inputs(self) -> Inputs:
        """Inputs of a model: the voltage without its noise, on a clock that starts with it."""
        return Inputs(
            self.path.voltage,
            interval=self.interval,
            voltage_is=self.voltage_is,
            covariates=self.covariates,
            quantities=self.quantities,
        )

    @property
    def has_reading(self) -> BoolArray:
        """True at the samples with a displacement reading, (samples,)."""
        if self.displacement is None:
            return np.zeros(self.samples, dtype=np.bool_)
        return ~np.isnan(self.displacement)

    @property
    def readings(self) -> int:
        """Number of samples at which the displacement was read."""
        return int(np.count_nonzero(self.has_reading))

    @property
    def range_voltage(self) -> tuple[float, float]:
        """Smallest and largest voltage, V."""
        return float(self.voltage.min()), float(self.voltage.max())

    @property
    def starts_at_zero(self) -> bool:
        """True if the first voltage is zero to a hundredth of the range: perhaps from rest."""
        return abs(float(self.voltage[0])) <= 0.01 * float(np.ptp(self.voltage))

    @property
    def beginning(self) -> str:
        """First voltage and time at rest there, to a hundredth of the range, in words.

        A rest of at most a hundredth of the record counts as moving at once.
        """
        first = float(self.voltage[0])
        moving = np.abs(self.voltage - first) > 0.01 * float(np.ptp(self.voltage))
        still = int(np.argmax(moving))
        motion = f"at rest for {still * self.interval:.3g} s"
        return f"starts at {first:.3g} V, {motion if still > self.samples // 100 else 'moving'}"

    @property
    def sha256(self) -> str:
        """Hex digest of the data: all inputs, displacement, interval and start, not the origin."""
        digest = hashlib.sha256(f"{self.samples} {self.displacement is not None}\n".encode())
        digest.update(np.array([self.interval, self.start], dtype="<f8").tobytes())
        digest.update(self.voltage.astype("<f8").tobytes())
        if self.displacement is not None:
            digest.update(self.displacement.astype("<f8").tobytes())
        for name, values in sorted(self.covariates.items()):
            digest.update(f"{name}\n".encode())
            digest.update(values.astype("<f8").tobytes())
        return digest.hexdigest()

    def like(self, other: Record) -> Record:
        """Return the record with quantities, units, instruments and corners as another has them.

        Raises
        ------
        InputError
            It states other quantities, or other uncertainties of its instruments.
        """
        if self.instruments not in (EXACT, other.instruments):
            raise InputError(
                f"{self.origin}: states other uncertainties of its units than {other.origin}; a "
                "fit's records are read by the same instruments: state the same, or none"
            )
        own, theirs = self.quantities, other.quantities
        stated = (own.input, own.output) != (theirs.input, theirs.output)
        if stated and not own.are_default:
            raise InputError(
                f"{self.origin}: is of {own.input} and {own.output}, not of {theirs.input} and "
                f"{theirs.output}; state these as its input and output"
            )
        return replace(
            self, quantities=theirs, instruments=other.instruments, corners=other.corners
        )

    def window_slice(self, start: float, stop: float) -> slice:
        """Return the slice of the samples with start <= time < stop.

        Times within half an interval of a border count as on it, so windows that share a border
        share no sample and leave none out.

        Raises
        ------
        InputError
            If the window is empty or reaches outside the record; the text names the record's span.
        """
        # Whole samples from the record's start, rounded half down: border - interval/2 <= time.
        borders = np.ceil(self._offsets([start, stop]) - 0.5)
        first, last = (int(border) for border in borders)
        if first < 0 or last > self.samples:
            problem = "reaches outside the record"
        elif first >= last:
            problem = "holds no sample"
        else:
            return slice(first, last)
        end = self.start + self.duration
        raise InputError(
            f"window {self.clock(start)} to {self.clock(stop)} s: {problem}; choose start < stop "
            f"within {self.clock(self.start)} to {self.clock(end)} s"
        )

    @property
    def longest_gap(self) -> tuple[float, float] | None:
        """Start and end of the longest time without readings, s; None if all gaps are alike."""
        edges = np.concatenate([[-1], np.flatnonzero(self.has_reading), [self.samples]])
        gaps = np.diff(edges)
        if np.max(gaps) <= 2 * np.median(gaps):
            return None
        first = int(edges[np.argmax(gaps)]) + 1
        stop = first + int(np.max(gaps)) - 1
        return self.start + first * self.interval, self.start + stop * self.interval

    def clock(self, time: float) -> str:
        """Write a time, s, with the decimals that distinguish neighboring samples."""
        return clock(time, self.interval)

    def window(self, start: float, stop: float) -> Record:
        """Return the record of the samples with start <= time < stop (s), see `window_slice`."""
        return self[self.window_slice(start, stop)]

    def upto(self, stop: float, first_reading: float | None = None) -> Record:
        """Return the record before `stop`, without the readings before `first_reading` (both s).

        The voltage is kept from the first sample on: its history before the readings that count
        determines the state of the hysteresis.
        """
        end = self.window_slice(self.start if first_reading is None else first_reading, stop)
        record = self[: end.stop]
        return record if first_reading is None else record.without(slice(0, end.start))

    def without(self, left_out: slice | BoolArray | IntArray) -> Record:
        """Return the record without the readings at the samples `left_out`, a slice or index."""
        if self.displacement is None:
            return self
        displacement = self.displacement.copy()
        displacement[left_out] = np.nan
        return replace(self, displacement=displacement)

    def without_values(self, values: Sequence[float]) -> Record:
        """Return the record without the readings that are one of `values`, um, to nine digits."""
        if self.displacement is None or not values:
            return self
        columns = self.displacement[:, np.newaxis]
        return self.without(np.isclose(columns, values, rtol=1e-9, atol=0.0).any(axis=1))

    def exclude(self, windows: Sequence[Window]) -> Record:
        """Return the record without the readings in `windows`, pairs (start, stop) in s.

        A window that begins or ends between two samples takes both of them.
        """
        left_out = np.zeros(self.samples, dtype=np.bool_)
        for start, stop in windows:
            # Refuse windows that are outside, or end before they begin.
            self.window_slice(start, max(stop, start + self.interval) if start < stop else stop)
            first, last = self._offsets([start, stop])
            rounding = 1e-6  # of a sample
            left_out[max(math.floor(first + rounding), 0) : math.ceil(last - rounding)] = True
        return self.without(left_out)

    def decimate(self, factor: int) -> Record:
        """Return the record with every `factor`-th reading, from the first one on.

        Only readings are left out. The voltage keeps all its samples, because its turning points
        are what the hysteresis remembers, and a thinned voltage would move them.
        """
        if factor != int(factor) or factor < 1:
            raise InputError(f"decimate: {factor} is not a whole number of samples; give 1 or more")
        readings = np.flatnonzero(self.has_reading)[:: int(factor)]
        left_out = np.ones(self.samples, dtype=np.bool_)
        left_out[readings] = False
        return self.without(left_out)

    def each_series(self, change: Callable[..., FloatArray], *others: Inputs) -> dict[str, Any]:
        """Apply a change to every series and to the same series of others; return all by field."""
        series = super().each_series(change, *others)
        for name in ("displacement", "truth"):
            values = [getattr(record, name, None) for record in (self, *others)]
            series[name] = None if any(v is None for v in values) else change(*values)
        return series

    def _offsets(self, times: Sequence[float]) -> FloatArray:
        """Return the samples from the start to times, s, clipped slightly beyond both ends."""
        offsets = (np.asarray(times, dtype=np.float64) - self.start) / self.interval
        if np.isnan(offsets).any():
            raise InputError(f"window: {times} s: not times; give them in s")
        return np.clip(offsets, -2.0, self.samples + 2.0)


def _frozen(name: str, values: ArrayLike, samples: int) -> FloatArray:
    """Return a read-only vector of ``samples`` finite numbers.

    A displacement may be nan (missing) at all samples but one.
    """
    try:
        vector = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: not numbers ({error}); give real numbers") from error
    if vector.ndim != 1 or vector.size == 0:
        raise InputError(f"{name}: shape {vector.shape} is not a vector; give (samples,)")
    if vector.size != samples:
        raise InputError(f"{name}: {vector.size} samples, voltage has {samples}; give the same")
    missing = np.isnan(vector) & (name == "displacement")
    if missing.all():
        raise InputError(f"{name}: holds no reading; give at least one")
    vector[missing] = np.nan  # one bit pattern for all: a digest distinguishes kinds of nan
    finite = np.isfinite(vector) | missing
    if not finite.all():
        sample = int(np.argmin(finite))
        raise InputError(f"{name}: {vector[sample]} at sample {sample}; give finite numbers")
    vector.setflags(write=False)
    return vector

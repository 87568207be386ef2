#include "binning.hpp"

#include <bit>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <tuple>
#include <utility>

namespace graings {

namespace {

constexpr int64_t kMaxEntries = 1 << 24;  // per tile: entry numbers are stored in R, where they must be exact
constexpr int64_t kMaxInsertionSort = 24;               // pairs; longer lists go through the radix passes first
constexpr int kMaxDigitBits = 11;

uint64_t bits_of_depth(double depth) { return std::bit_cast<uint64_t>(depth); }  // bit patterns of positive numbers have the order of the numbers

// For so few tiles, the row-by-row test costs more than the tiles it removes.
bool is_small(const Span& span) { return span.count <= 16; }

// Calls visit(row of tiles, first tile column, last tile column) for the tiles that the record's ellipse may touch.
template <class R, class Visit>
void each_tile_row(const Record<R>& record, const Span& span, int64_t width, Visit visit) {
    const double sr = double(record.params.sr), sy = double(record.params.sy), level = double(record.params.level), steep = record.slope * sr;
    const double highest = std::sqrt(level) / sy, turn = highest * steep / std::sqrt(steep * steep + sy * sy);
    for (uint32_t row = span.first_row(); row <= span.last_row(); row++) {
        const double low = std::max(double(row * kTile) + 0.5 - record.y, -highest);
        const double high = std::min(double(row * kTile + kTile) - 0.5 - record.y, highest);
        if (low > high) continue;
        const auto edge = [&](double side) {
            const double dy = std::clamp(side * turn, low, high), s = dy * sy;
            return record.x + record.slope * dy + side * std::sqrt(std::max(level - s * s, 0.0)) / sr;
        };
        // first and last pixel centre inside
        const double from = std::ceil(std::max(edge(-1) - 0.5, 0.0)), to = std::floor(std::min(edge(1) - 0.5, double(width) - 1));
        if (from > to) continue;
        const uint32_t first = std::max(uint32_t(from) / kTile, span.first_column()), last = std::min(uint32_t(to) / kTile, span.last_column());
        if (first <= last) visit(row, first, last);
    }
}

// Masks of a tile's blocks, one bit each, row by row: from a column or row of blocks on, and up to it.
constexpr uint32_t kColumnsFrom[] = {0xFFFF, 0xEEEE, 0xCCCC, 0x8888}, kColumnsTo[] = {0x1111, 0x3333, 0x7777, 0xFFFF};
constexpr uint32_t kRowsFrom[] = {0xFFFF, 0xFFF0, 0xFF00, 0xF000}, kRowsTo[] = {0x000F, 0x00FF, 0x0FFF, 0xFFFF};

}  // namespace

template <class R>
Binning<R>::Binning(const Camera& camera, bool compat, int64_t gaussians, const Record<R>* records, Span* spans, const double* depths, const int64_t* uids, int threads)
    : begin(size_t(pieces_of(camera.width, kTile) * pieces_of(camera.height, kTile)) + 1), places(size_t(gaussians) + 1), across_(pieces_of(camera.width, kTile)),
      tiles_(across_ * pieces_of(camera.height, kTile)), width_(camera.width), compat_(compat), records_(records), spans_(spans),
      depths_(depths), uids_(uids), threads_(threads), counts_(size_t(threads)) {}

template <class R>
void Binning<R>::count(Piece& piece) {
    auto& counts = counts_[size_t(piece.worker)];
    if (counts.empty()) counts.assign(size_t(tiles_ + across_ + 1), 0);  // padding: the branchless path below adds 0 beyond the last tile
    uint32_t* tile = counts.data();
    for (int64_t i = piece.begin; i < piece.end; i++) {
        Span& span = spans_[i];
        places[size_t(i)] = uint32_t(piece.pairs);  // relative to the piece
        if (span.count == 0) continue;
        const uint32_t columns = span.last_column() - span.first_column(), rows = span.last_row() - span.first_row();
        uint32_t* first = tile + span.first_row() * across_ + span.first_column();
        if ((columns | rows) < 2) {  // most Gaussians: one or two tiles each way, without a branch
            first[0]++, first[1] += columns, first[across_] += rows, first[across_ + 1] += columns & rows;
        } else if (compat_ || is_small(span)) {
            for (uint32_t row = 0; row <= rows; row++, first += across_)
                for (uint32_t column = 0; column <= columns; column++) first[column]++;
        } else {
            span.count = 0;
            each_tile_row(records_[i], span, width_, [&](int64_t row, uint32_t from, uint32_t to) {
                span.count += to - from + 1;
                for (int64_t column = from; column <= to; column++) tile[row * across_ + column]++;
            });
            if (span.count == 0) continue;
        }
        piece.pairs += span.count;
        const uint64_t depth = bits_of_depth(depths_[i]);
        piece.least = std::min(piece.least, depth), piece.most = std::max(piece.most, depth);
    }
}

template <class R>
uint32_t Binning<R>::key(int64_t id) const {
    const uint64_t above = bits_of_depth(depths_[id]) - least_;
    return uint32_t(spare_bits_ < 0 ? above >> -spare_bits_ : above << spare_bits_);
}

template <class R>
void Binning<R>::enter(const std::vector<Piece>& pieces) {
    uint64_t most = 0;
    std::vector<int64_t> places_at;
    for (const Piece& piece : pieces) {
        places_at.push_back(count_);
        count_ += piece.pairs;
        least_ = std::min(least_, piece.least), most = std::max(most, piece.most);
    }
    if (count_ > int64_t(std::numeric_limits<uint32_t>::max())) throw std::length_error("more than 2^32 pairs of tile and Gaussian");
    spare_bits_ = count_ ? 32 - int(std::bit_width(most - least_)) : 0;
    int64_t total = 0;
    for (int64_t tile = 0; tile < tiles_; tile++) {
        begin[size_t(tile)] = total;
        for (auto& counts : counts_)  // counts become write positions
            if (!counts.empty()) total += std::exchange(counts[size_t(tile)], uint32_t(total));
        if (total - begin[size_t(tile)] > kMaxEntries) throw std::length_error("more than 2^24 Gaussians on one tile");
    }
    begin[size_t(tiles_)] = total;
    places[pieces.empty() ? 0 : size_t(pieces.back().end)] = uint32_t(total);
    pairs = Buffer<Pair>(size_t(count_));
    parallel_for(threads_, int64_t(counts_.size()), [&](int, int64_t worker) {
        for (size_t k = 0; k < pieces.size(); k++)
            if (pieces[k].worker == worker) enter(pieces[k], uint32_t(places_at[k]), counts_[size_t(worker)].data());
    });
}

template <class R>
void Binning<R>::enter(const Piece& piece, uint32_t first_place, uint32_t* next) {
    Pair nowhere, *out = pairs.get();
    for (int64_t i = piece.begin; i < piece.end; i++) {
        const Span& span = spans_[i];
        const uint32_t begin = places[size_t(i)] += first_place;
        if (span.count == 0) continue;
        const uint32_t id = uint32_t(i), depth = key(i), columns = span.last_column() - span.first_column(), rows = span.last_row() - span.first_row();
        const uint32_t left = kColumnsFrom[span.left % Span::kPerTile], right = kColumnsTo[span.right % Span::kPerTile];
        const uint32_t top = kRowsFrom[span.top % Span::kPerTile], bottom = kRowsTo[span.bottom % Span::kPerTile];
        if ((columns | rows) < 2) {  // most Gaussians, as above
            uint32_t* at = next + span.first_row() * across_ + span.first_column();
            const uint32_t first_columns = columns ? left : left & right, first_rows = rows ? top : top & bottom;
            const auto put = [&](uint32_t& to, uint32_t there, uint32_t place, uint32_t mask) {
                Pair* pair = out + to;
                pair = there ? pair : &nowhere;
                __builtin_prefetch(pair + 4, 1);  // for the next pairs of this tile
                *pair = {depth, id, place, mask}, to += there;
            };
            put(at[0], 1, begin, first_columns & first_rows);
            if (columns & rows) {  // a quarter of them: too rare to write all four pairs always
                put(at[1], 1, begin + 1, right & first_rows);
                put(at[across_], 1, begin + 2, first_columns & bottom), put(at[across_ + 1], 1, begin + 3, right & bottom);
            } else
                put(at[columns ? 1 : across_], columns | rows, begin + 1, columns ? right & first_rows : first_columns & bottom);
            continue;
        }
        uint32_t place = begin;
        const auto put_row = [&](uint32_t row, uint32_t from, uint32_t to) {
            const uint32_t in_row = (row == span.first_row() ? top : 0xFFFF) & (row == span.last_row() ? bottom : 0xFFFF);
            uint32_t* at = next + int64_t(row) * across_;
            for (uint32_t column = from; column <= to; column++) {
                Pair* pair = out + at[column]++;
                __builtin_prefetch(pair + 4, 1);
                *pair = {depth, id, place++, in_row & (column == span.first_column() ? left : 0xFFFF) & (column == span.last_column() ? right : 0xFFFF)};
            }
        };
        if (span.is_box())
            for (uint32_t row = span.first_row(); row <= span.last_row(); row++) put_row(row, span.first_column(), span.last_column());
        else
            each_tile_row(records_[i], span, width_, put_row);
    }
}

template <class R>
void Binning<R>::sort() {
    std::vector<std::vector<Pair>> halves{size_t(threads_)};
    each_tile(threads_, tiles_, [&](int worker, int64_t tile, int64_t) {
        const int64_t first = begin[size_t(tile)];
        sort(pairs.get() + first, begin[size_t(tile) + 1] - first, halves[size_t(worker)]);
    });
}

// Two radix passes over the leading bits of the key, as many as make equal neighbours rare, then insertion sort by full
// comparison. `half` is the output of the first pass.
template <class R>
void Binning<R>::sort(Pair* pairs, int64_t count, std::vector<Pair>& half) const {
    const auto before = [&](const Pair& a, const Pair& b) {
        if (a.key != b.key) return a.key < b.key;
        return std::tuple(depths_[a.id], uids_[a.id], a.id) < std::tuple(depths_[b.id], uids_[b.id], b.id);
    };
    if (count > kMaxInsertionSort) {
        if (int64_t(half.size()) < count) half.resize(size_t(2 * count));
        uint32_t least = ~uint32_t(0), most = 0;
        for (int64_t i = 0; i < count; i++) least = std::min(least, pairs[i].key), most = std::max(most, pairs[i].key);
        const int digit = std::min(int(std::bit_width(uint64_t(count))) - 1, kMaxDigitBits), bins = 1 << digit;
        const int shift = std::max(int(std::bit_width(most - least)) - 2 * digit, 0);
        const auto lead = [&](uint32_t key) { return (key - least) >> shift; };
        uint32_t low[1 << kMaxDigitBits], high[1 << kMaxDigitBits];
        std::fill_n(low, bins, 0), std::fill_n(high, bins, 0);
        for (int64_t i = 0; i < count; i++) {
            const uint32_t l = lead(pairs[i].key);
            low[l & (bins - 1)]++, high[l >> digit]++;
        }
        uint32_t low_total = 0, high_total = 0;
        for (int bin = 0; bin < bins; bin++) low_total += std::exchange(low[bin], low_total), high_total += std::exchange(high[bin], high_total);
        for (int64_t i = 0; i < count; i++) half[low[lead(pairs[i].key) & (bins - 1)]++] = pairs[i];
        for (int64_t i = 0; i < count; i++) pairs[high[lead(half[size_t(i)].key) >> digit]++] = half[size_t(i)];
    }
    int64_t moves = 16 * count;  // beyond this std::sort takes over, whose worst case is n log n
    for (int64_t i = 1; i < count; i++) {
        if (!before(pairs[i], pairs[i - 1])) continue;
        const Pair pair = pairs[i];
        int64_t j = i;
        for (; j > 0 && before(pair, pairs[j - 1]); j--) pairs[j] = pairs[j - 1];
        pairs[j] = pair;
        if ((moves -= i - j) < 0) {
            std::sort(pairs, pairs + count, before);
            break;
        }
    }
}

template class Binning<float>;
template class Binning<double>;

}  // namespace graings

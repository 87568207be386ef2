#include "pool.hpp"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <exception>
#include <list>
#include <mutex>
#include <thread>
#include <utility>
#if defined(__unix__) || defined(__APPLE__)
#include <pthread.h>
#endif
#ifdef __linux__
#include <sched.h>
#endif

namespace graings {
namespace {

// Loops follow each other closely within a step, and waking a sleeping thread takes longer than many of them. A waiting
// thread therefore spins for kSpinTime before it sleeps, after kYieldAfter with yields in between. A yield that takes
// longer than kLateYield means that another thread uses the core; then it sleeps at once.
constexpr std::chrono::microseconds kSpinTime{1500}, kYieldAfter{60}, kLateYield{30};

void relax() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    asm volatile("yield");
#endif
}

template <class Done>
bool spin_until(Done done) {
    const auto begin = std::chrono::steady_clock::now();
    for (auto now = begin; now < begin + kSpinTime;) {
        for (int i = 0; i < 16; i++) {
            if (done()) return true;
            relax();
        }
        const bool yielded = now > begin + kYieldAfter;
        if (yielded) std::this_thread::yield();
        const auto before = std::exchange(now, std::chrono::steady_clock::now());
        if (yielded && now > before + kLateYield) break;
    }
    return done();
}

// A thread of the pool, and the CPU it last ran on.
struct Worker {
    std::thread thread;
    std::atomic<int> cpu{-1};

#ifdef __linux__
    void record_cpu() { cpu.store(sched_getcpu(), std::memory_order_relaxed); }
    // Linux tends to wake a thread on the CPU where it slept, even if the waking thread runs there and other CPUs are idle;
    // the two then share it for milliseconds.
    void avoid_cpu(int busy, const cpu_set_t& usable) {
        if (cpu.load(std::memory_order_relaxed) != busy) return;
        cpu_set_t others = usable;
        CPU_CLR(busy, &others);
        if (CPU_COUNT(&others) > 0) pthread_setaffinity_np(thread.native_handle(), sizeof others, &others);
    }
#else
    void record_cpu() {}
#endif
};

struct Job {
    const std::function<void(int, int64_t)>* body;
    int64_t pieces;
    int seats;  // workers that may still join
    int next_worker = 1;
    std::atomic<int> inside{0};
    std::atomic<int64_t> next{0};
    std::exception_ptr error{};

    void work(int worker) {
        for (int64_t piece; (piece = next.fetch_add(1, std::memory_order_relaxed)) < pieces;) (*body)(worker, piece);
    }
};

class Pool {
public:
    void run(int threads, int64_t pieces, const std::function<void(int, int64_t)>& body) {
        Job job{&body, pieces, threads - 1};
        {
            std::lock_guard lock(mutex_);
            while (int(workers_.size()) < threads - 1) {
                Worker& worker = workers_.emplace_back();
                worker.thread = std::thread([this, &worker] { serve(worker); });  // ends with the process
            }
#ifdef __linux__
            cpu_set_t usable;
            if (sched_getaffinity(0, sizeof usable, &usable) == 0)
                for (Worker& worker : workers_) worker.avoid_cpu(sched_getcpu(), usable);
#endif
            jobs_.push_back(&job);
            posted_.fetch_add(1, std::memory_order_release);
        }
        wake_.notify_all();
        std::exception_ptr error;
        try {
            job.work(0);
        } catch (...) {
            error = std::current_exception();
            job.next.store(pieces, std::memory_order_relaxed);
        }
        spin_until([&] { return job.inside.load(std::memory_order_acquire) == 0; });
        std::unique_lock lock(mutex_);
        jobs_.remove(&job);
        left_.wait(lock, [&] { return job.inside == 0; });
        if (!error) error = job.error;
        if (error) std::rethrow_exception(error);
    }

private:
    [[noreturn]] void serve(Worker& self) {
        for (int64_t seen = 0;;) {
            spin_until([&] { return posted_.load(std::memory_order_acquire) != seen; });
            std::unique_lock lock(mutex_);
            Job* job = nullptr;
            wake_.wait(lock, [&] {
                for (Job* candidate : jobs_)
                    if (candidate->seats > 0) { job = candidate; return true; }
                return false;
            });
            seen = posted_.load(std::memory_order_relaxed);
            job->seats--, job->inside++;
            const int worker = job->next_worker++;
            lock.unlock();
            std::exception_ptr error;
            try {
                job->work(worker);
            } catch (...) {
                error = std::current_exception();
                job->next.store(job->pieces, std::memory_order_relaxed);
            }
            self.record_cpu();
            lock.lock();
            if (error && !job->error) job->error = error;
            if (--job->inside == 0) left_.notify_all();
        }
    }

    std::mutex mutex_;
    std::condition_variable wake_, left_;
    std::list<Job*> jobs_;
    std::list<Worker> workers_;  // never shrinks
    std::atomic<int64_t> posted_{0};
};

// Never destroyed: its threads outlive static destruction.
Pool* current = nullptr;

Pool& pool() {
    static const bool made = [] {
        current = new Pool;
#if defined(__unix__) || defined(__APPLE__)
        // A child of fork() has the memory of the pool and none of its threads; its lock may be held for ever.
        pthread_atfork(nullptr, nullptr, [] { current = new Pool; });
#endif
        return true;
    }();
    static_cast<void>(made);
    return *current;
}

}  // namespace

void parallel_for(int threads, int64_t pieces, const std::function<void(int, int64_t)>& body) {
    threads = int(std::min<int64_t>(threads, pieces));
    if (threads <= 1) {
        for (int64_t piece = 0; piece < pieces; piece++) body(0, piece);
        return;
    }
    pool().run(threads, pieces, body);
}

}  // namespace graings
